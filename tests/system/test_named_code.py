"""What comments and docstrings name exists: errors that are raised, and `module.name` in backticks."""

from __future__ import annotations

import ast
import builtins
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import ROOT

ROOMS = ("capture", "recon", "viewer", "splatnode/api", "extras")
NATIVE = ("recon/core/*.cpp", "recon/core/*.h", "extras/entry_points.txt", "pyproject.toml")
DOTTED = re.compile(r"`([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)(?:\([^`]*\))?`")
RAISED = re.compile(r"\b[Rr]aises? ((?:[A-Z]\w+(?:, (?:and )?| and | or )?)+)")
SUFFIXES = {"bin", "jpg", "json", "npy", "npz", "ply", "png", "py", "txt", "yaml"}  # of files


def sources() -> list[Path]:
    return [
        *(ROOT / "splatnode").glob("*.py"),
        *(path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))),
    ]


def names_in(tree: ast.AST) -> Iterator[str]:
    """Whatever the code itself calls by a name, or by a string that is one."""
    for node in ast.walk(tree):
        match node:
            case ast.ClassDef(name=name) | ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                yield name
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name) | ast.keyword(arg=str(name)):
                yield name
            case ast.alias(name=name, asname=other):
                yield from (*name.split("."), other or "")
            case ast.Constant(value=str(name)) if name.isidentifier():
                yield name


def words_about(source: str, tree: ast.AST) -> Iterator[str]:
    """The comments and the docstrings."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.string
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""


def unknown(text: str, known: set[str]) -> list[str]:
    """What a text names that is not known."""
    last = [name.rpartition(".")[2] for name in DOTTED.findall(text)]
    errors = [name for match in RAISED.findall(text) for name in re.findall(r"[A-Z]\w+", match)]
    return [name for name in (*last, *errors) if name not in known and name not in SUFFIXES]


def test_what_comments_name_exists():
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sources()}
    known = {*dir(builtins), *(part for path in trees for part in path.relative_to(ROOT).with_suffix("").parts)}
    for tree in trees.values():
        known.update(names_in(tree))
    for pattern in NATIVE:
        for path in ROOT.glob(pattern):
            known.update(re.findall(r"\w+", path.read_text(encoding="utf-8")))
    found = [
        f"{path.relative_to(ROOT)}: {name}"
        for path, tree in trees.items()
        for text in words_about(path.read_text(encoding="utf-8"), tree)
        for name in unknown(text, known)
    ]
    assert found == []


def test_what_is_gone_is_found():
    known = {"LockHeld", "OSError", "find_path"}
    assert unknown("Raises LockHeld, OSError.", known) == []
    assert unknown("Raises OSError, and Held where another process holds it.", known) == ["Held"]
    assert unknown("Raises Held, OSError.", known) == ["Held"]
    assert unknown("as `path.find_path` and `path.seek(step)` do, see `files.json`", known) == ["seek"]
