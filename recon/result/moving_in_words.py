"""What moved between the photographs, in a sentence."""

from __future__ import annotations

from collections.abc import Mapping

LEAST = 0.03  # share of a photograph: less is in the report alone


def describe_moving(shares: Mapping[str, float]) -> str:
    """The photographs of which so much was left out that their user should know; empty where there is none."""
    told = [share for share in shares.values() if share >= LEAST]
    if not told:
        return ""
    least, most = f"{min(told):.0%}", f"{max(told):.0%}"
    each = least if least == most else f"{least} to {most}"
    of = f"{len(told)} photographs" if len(told) > 1 else "a photograph"
    return f"left out of {of}: what moved between them, {each} of each (report.json names them)"
