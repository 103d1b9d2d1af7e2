"""The fitted numbers as the Python module recon/verification/fitted.py."""

from __future__ import annotations

from dataclasses import fields

from splatnode.recon.verification.claims import BoundModel
from splatnode.recon.verification.likelihood import Term
from splatnode.recon.verification.models import Fitted, Numbers

HEAD = '''"""The numbers of the verdict. Written by `python -m tests.bench fit`; do not edit."""

from __future__ import annotations

from splatnode.recon.verification.claims import BoundModel, ClaimModel
from splatnode.recon.verification.likelihood import OddsModel, Term
from splatnode.recon.verification.models import Fitted, Numbers

'''


def source(numbers: Fitted) -> str:
    return HEAD + "\n".join(
        ["FITTED = Fitted(", *_numbers("many", numbers.many), *_numbers("pair", numbers.pair), ")", ""]
    )


def _numbers(name: str, numbers: Numbers) -> list[str]:
    bounds = [f"            {f.name}={_call(getattr(numbers.claims, f.name))}," for f in fields(numbers.claims)]
    terms = [f'                "{name}": {_call(term)},' for name, term in numbers.odds.terms.items()]
    return [
        f"    {name}=Numbers(",
        "        claims=ClaimModel(",
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


def _call(record: BoundModel | Term) -> str:
    """The record as Python, in one line."""
    numbers = ", ".join(f"{field.name}={getattr(record, field.name)!r}" for field in fields(record))
    return f"{type(record).__name__}({numbers})"
