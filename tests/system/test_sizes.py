"""Product code stays small enough to read: files and functions have a largest length."""

from __future__ import annotations

import ast
from pathlib import Path

from tests.conftest import ROOT

MAX_FILE_LINES = 800
MAX_FUNCTION_LINES = 80
ROOMS = ("capture", "recon", "viewer", "extras", "splatnode")


def long_files(root: Path) -> list[str]:
    """Python and C++ files with more than MAX_FILE_LINES lines."""
    lengths = {path: len(path.read_text().splitlines()) for path in _sources(root, ".py", ".cpp", ".h")}
    return [f"{path.relative_to(root)}: {lines} lines" for path, lines in lengths.items() if lines > MAX_FILE_LINES]


def long_functions(root: Path) -> list[str]:
    """Python functions with more than MAX_FUNCTION_LINES lines, from `def` to the last line of the body."""
    return [
        f"{path.relative_to(root)}:{node.lineno} {node.name}: {lines} lines"
        for path in _sources(root, ".py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (lines := (node.end_lineno or node.lineno) - node.lineno + 1) > MAX_FUNCTION_LINES
    ]


def _sources(root: Path, *suffixes: str) -> list[Path]:
    """Of the rooms; links among them are followed once, from the top level."""
    found = (path for room in ROOMS for path in sorted((root / room).rglob("*")))
    return [path for path in found if path.suffix in suffixes and not path.is_symlink()]


def test_no_product_file_is_longer_than_a_reader_takes_in():
    assert long_files(ROOT) == []


def test_no_function_is_longer_than_a_screen():
    assert long_functions(ROOT) == []


def test_what_is_too_long_is_named(tmp_path):
    room = tmp_path / "recon"
    room.mkdir()
    (room / "long.py").write_text("def told():\n" + "    pass\n" * MAX_FUNCTION_LINES + "x = 1\n" * MAX_FILE_LINES)
    (room / "core.cpp").write_text("\n" * (MAX_FILE_LINES + 1))
    assert long_files(tmp_path) == ["recon/core.cpp: 801 lines", "recon/long.py: 881 lines"]
    assert long_functions(tmp_path) == ["recon/long.py:1 told: 81 lines"]
