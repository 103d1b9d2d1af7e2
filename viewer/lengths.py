"""Lengths as a person reads them: in metres where the scale is known, otherwise with the word that says so."""

from __future__ import annotations

from splatnode.recon.result.scale import Scale

_UNITS = ((1.0, "m"), (0.01, "cm"), (0.001, "mm"))  # metres of a unit and its sign, the largest first


def format_length(length: float, scale: Scale) -> str:
    """A length in the world's unit, to three digits: "42 cm", or "0.42 relative"."""
    if not scale.metric:
        return f"{_format_number(length)} relative"
    unit, sign = next((each for each in _UNITS if length >= each[0] * (1 - 1e-9)), _UNITS[-1])
    return f"{_format_number(length / unit)} {sign}"


def _format_number(value: float) -> str:
    """Three significant digits, without an exponent."""
    return f"{float(f'{value:.3g}'):.10f}".rstrip("0").rstrip(".")
