"""No text that came from elsewhere is a template: what fills one in would do what the text says.

A width in a format takes gigabytes, and a field of one reads attributes of what fills it in.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest

from tests.conftest import ROOT

ROOMS = ("capture", "recon", "viewer", "extras", "splatnode")
_OWN = {  # templates, and widths, of the program's own that are no constants where they are filled in
    "capture/cli.py": {"longest"},
    "extras/evaluate/report.py": {"digits", "measure.digits"},
    "recon/result/snapshot.py": {"max(decimals, 0)"},
}
_LEVELS = {"debug", "info", "warning", "error", "exception", "critical"}


def templates(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of each place at which something that is no constant is filled in as a template."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            of, name = node.func.value, node.func.attr
            filled = bool(node.args or node.keywords)
            if name in ("format", "format_map", "vformat") and filled and not _is_constant(of):
                if not any(ast.unparse(each) == "record" for each in node.args):  # logging.Formatter.format
                    yield node.lineno, ast.unparse(node.func)
            elif name in _LEVELS and ast.unparse(of) in ("log", "logger", "logging") and len(node.args) > 1:
                if not _is_constant(node.args[0]):
                    yield node.lineno, ast.unparse(node)
            elif name in ("substitute", "safe_substitute"):
                yield node.lineno, ast.unparse(node.func)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "format" and len(node.args) > 1:
            if not _is_constant(node.args[1]):
                yield node.lineno, ast.unparse(node)
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mod) and not _is_constant(node.left):
            text = isinstance(node.right, (ast.Tuple, ast.Dict, ast.JoinedStr)) or _is_text(node.left)
            if text:
                yield node.lineno, ast.unparse(node)
        elif isinstance(node, ast.FormattedValue) and isinstance(node.format_spec, ast.JoinedStr):
            for part in node.format_spec.values:
                if isinstance(part, ast.FormattedValue) and not _is_constant(part.value):
                    yield node.lineno, ast.unparse(part.value)


def _is_constant(node: ast.expr) -> bool:
    """A literal, or a name of a constant, which is in capitals."""
    if isinstance(node, ast.Name):
        return node.id.isupper()
    if isinstance(node, ast.Attribute):
        return node.attr.isupper()
    return isinstance(node, ast.Constant)


def _is_text(node: ast.expr) -> bool:
    said = ast.unparse(node)
    return isinstance(node, ast.JoinedStr) or said.startswith("str(") or said.endswith((".decode()", ".read_text()"))


def test_no_text_from_elsewhere_is_filled_in_as_a_template():
    found = [
        f"{name}:{line}: {text}"
        for room in ROOMS
        for path in sorted((ROOT / room).rglob("*.py"))
        if not path.is_symlink() and not any(part.is_symlink() for part in path.parents if part != ROOT)
        for name in [str(path.relative_to(ROOT))]
        for line, text in templates(path.read_text())
        if text not in _OWN.get(name, ())
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "line",
    [
        "path.format(a=1)",
        "str(info.video_path).format(video_key=key)",
        "text.format_map(values)",
        "template % (a, b)",
        "str(a) % b",
        "format(a, spec)",
        "f'{a:{width}}'",
        "log.info(text, a)",
        "Template(a).substitute(b)",
    ],
)
def test_the_search_finds(line):
    assert list(templates(line))


@pytest.mark.parametrize("line", ["'{a}'.format(a=1)", "TEXT.format(1)", "a % 2", "'%d' % a", "f'{a:>3}'", "a.format"])
def test_the_search_leaves(line):
    assert not list(templates(line))
