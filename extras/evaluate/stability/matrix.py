"""All rows, by number: every `MatrixRow` of the modules in `_FAMILIES`.

A new row is one function in one of these files; a new file of rows is that file and its name in `_FAMILIES`. Those of
`lens_assumptions` are made from its kinds.
"""

from __future__ import annotations

from collections.abc import Collection

from splatnode.extras.evaluate.stability import cases, degradations, lens_assumptions
from splatnode.extras.evaluate.stability.case import MatrixRow

_FAMILIES = (cases, degradations)

ROWS: tuple[MatrixRow, ...] = tuple(
    sorted(
        (
            *(found for family in _FAMILIES for found in vars(family).values() if isinstance(found, MatrixRow)),
            *lens_assumptions.ROWS,
        ),
        key=lambda r: r.number,
    )
)


def select_rows(numbers: Collection[int]) -> tuple[MatrixRow, ...]:
    """The rows with these numbers; all, where there are none. Raises ValueError for a number that no row has."""
    known = {found.number for found in ROWS}
    unknown = sorted(set(numbers) - known)
    if unknown:
        raise ValueError(f"no row {', '.join(map(str, unknown))}; there are {min(known)} to {max(known)}")
    return tuple(found for found in ROWS if not numbers or found.number in numbers)
