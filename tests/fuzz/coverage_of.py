"""Which lines of a module a piece of code runs, of the functions that it enters."""

from __future__ import annotations

import ast
import contextlib
import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def lines_run(modules: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Fills the result at the end: by module, the share of lines, and those that were not run.

    A function that is not entered at all, such as the one that writes what another one reads, does not count.
    """
    import coverage

    sources = {module: _source(module) for module in modules}
    watched = coverage.Coverage(data_file=None, include=[str(source) for source in sources.values()])
    shares: dict[str, Any] = {}
    watched.start()
    try:
        yield shares
    finally:
        watched.stop()
    for module, source in sources.items():
        _, statements, _, missing, _ = watched.analysis2(str(source))
        run = set(statements) - set(missing)
        lines = {line for body in _functions(source) if body & run for line in body & set(statements)}
        shares[module] = {"share": len(lines & run) / max(1, len(lines)), "missed": sorted(lines - run)}


def _source(module: str) -> Path:
    found = importlib.util.find_spec(module)
    if found is None or found.origin is None:
        raise ValueError(f"no module {module}")
    return Path(found.origin)


def _functions(source: Path) -> list[set[int]]:
    """The lines of each function's body."""
    nodes = [node for node in ast.walk(ast.parse(source.read_text())) if isinstance(node, ast.FunctionDef)]
    return [{line for each in node.body for line in range(each.lineno, (each.end_lineno or 0) + 1)} for node in nodes]
