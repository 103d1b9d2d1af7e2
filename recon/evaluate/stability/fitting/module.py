"""The fitted numbers as the Python module recon/verification/fitted.py."""

from __future__ import annotations

from dataclasses import fields

from splatnode.recon.verification.claims import BoundModel
from splatnode.recon.verification.likelihood import Term
from splatnode.recon.verification.models import VerdictModel, VerdictModels

HEAD = '''"""The numbers of the verdict. Written by `python -m tests.bench fit`; do not edit."""

from __future__ import annotations

from splatnode.recon.verification.claims import BoundModel, ErrorModel
from splatnode.recon.verification.likelihood import OddsModel, Term
from splatnode.recon.verification.models import VerdictModels, VerdictModel

'''


def format_module(numbers: VerdictModels) -> str:
    return HEAD + "\n".join(
        ["FITTED = VerdictModels(", *_format_model("many", numbers.many), *_format_model("pair", numbers.pair), ")", ""]
    )


def _format_model(name: str, numbers: VerdictModel) -> list[str]:
    bounds = [f"            {f.name}={_format_call(getattr(numbers.claims, f.name))}," for f in fields(numbers.claims)]
    terms = [f'                "{name}": {_format_call(term)},' for name, term in numbers.odds.terms.items()]
    return [
        f"    {name}=VerdictModel(",
        "        claims=ErrorModel(",
        *bounds,
        "        ),",
        "        odds=OddsModel(",
        f"            prior={numbers.odds.prior!r},",
        "            terms={",
        *terms,
        "            },",
        "        ),",
        "    ),",
    ]


def _format_call(record: BoundModel | Term) -> str:
    """The record as Python, in one line."""
    numbers = ", ".join(f"{field.name}={getattr(record, field.name)!r}" for field in fields(record))
    return f"{type(record).__name__}({numbers})"
