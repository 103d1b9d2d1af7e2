"""The text of docs/api.md: the names of `import splatnode`, as their docstrings and comments tell of them."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
from collections.abc import Iterable, Iterator
from typing import Any

import splatnode
from splatnode.capture.frame import DroppedFrame, Stamp
from splatnode.capture.process.terminal import ProgressStep
from splatnode.recon.locating import LocalizationBounds
from splatnode.recon.occupancy import Upright
from splatnode.recon.result.snapshot import DepthCheck
from splatnode.recon.result.verdict import Bounds, ReferenceFrame, Verdict
from tests.reference.comments import field_comments

_INTRODUCTION = """# API

What `import splatnode` gives. Each name is loaded when it is first used, so that the import takes no time.
[Python](python.md) shows them at work.

Arrays are NumPy's. Axes are OpenCV's: x right, y down, z forward; quaternions are wxyz; the centre of the top-left
pixel is at (0.5, 0.5). The world is the frame of the first camera that was placed, or that of the poses that were
given, or [another one](frames.md). Records are frozen; they and results can be pickled, and used by several threads.

This page is made from the code by `python -m tests.reference`; change it there.
"""
_FUNCTIONS = ("reconstruct", "load", "connect", "make_depth_image")
_CLASSES = (
    "Result",
    "Camera",
    "View",
    "Session",
    "Update",
    "Node",
    "NodeUpdate",
    "NodeMap",
    "LiveLocation",
    "Publisher",
    "Published",
    "RefusedImage",
    "Located",
    "NotLocated",
    "OccupancyMap",
    "Intrinsics",
    "Marker",
    "Stereo",
    "DepthImage",
    "DepthNoise",
    "InputWarning",
)
_WIDE = 110  # characters
_FURTHER = (
    Verdict,
    DepthCheck,
    Bounds,
    LocalizationBounds,
    Upright,
    ReferenceFrame,
    DroppedFrame,
    Stamp,
    ProgressStep,
)  # what these lead to


def page() -> str:
    """The whole page, as Markdown."""
    functions = [_function(name, getattr(splatnode, name), "##") for name in _FUNCTIONS]
    classes = [_class(getattr(splatnode, name), f"splatnode.{name}") for name in _CLASSES]
    further = [_class(each, each.__name__, methods=False) for each in _FURTHER]
    return "\n".join([_INTRODUCTION, *functions, *classes, *further])


def told() -> set[str]:
    """The names of `splatnode` that the page tells of."""
    return {*_FUNCTIONS, *_CLASSES, Verdict.__name__}


def _class(documented: type, title: str, methods: bool = True) -> str:
    is_record = dataclasses.is_dataclass(documented)
    parts = [f"## {title}\n"]
    if not is_record and "__init__" in vars(documented) and documented.__init__.__doc__:
        parts += [_head(documented.__name__, documented.__init__), *_paragraphs(documented.__init__)]
    parts += _paragraphs(documented)
    own = list(_own(documented))
    parts += _table("field", _fields(documented) if is_record else ())
    parts += _table("property", (_property(*each) for each in own if isinstance(each[1], property)))
    for name, each in own if methods else ():
        if inspect.isfunction(each):
            parts.append(_function(f"{documented.__name__}.{name}", each, "###"))
    return "\n".join(parts)


def _table(what: str, rows: Iterable[str]) -> list[str]:
    found = list(rows)
    return [f"| {what} | type | what it is |\n|---|---|---|", *found, ""] if found else []


def _function(name: str, function: Any, level: str) -> str:
    title = name if "." in name else f"splatnode.{name}"
    return "\n".join([f"{level} {title}\n", _head(name, function), *_paragraphs(function)])


def _head(name: str, function: Any) -> str:
    """How it is called, as the source has it; a line an argument where that is long."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    assert isinstance(tree, ast.FunctionDef) and tree.returns is not None
    tree.args.args = [each for each in tree.args.args if each.arg != "self"]
    arguments = [each.replace("=", " = ") for each in re.split(r", (?=\w+: |\*)", ast.unparse(tree.args))]
    returned = ast.unparse(tree.returns)
    arrow = "" if function.__name__ == "__init__" else f" -> {returned}"
    call = f"{name}({', '.join(arguments)}){arrow}"
    if len(call) > _WIDE:
        call = "\n".join([f"{name}(", *(f"    {each}," for each in arguments), f"){arrow}"])
    return f"```python\n{call}\n```\n"


def _own(documented: type) -> Iterator[tuple[str, Any]]:
    """Public properties and methods, and `__iter__`, with a docstring, in the order of the source."""
    for name, each in vars(documented).items():
        if (not name.startswith("_") or name == "__iter__") and inspect.getdoc(each) and not isinstance(each, type):
            yield name, each


def _fields(documented: type) -> Iterator[str]:
    comments = field_comments(documented)
    for each in dataclasses.fields(documented):
        if not each.name.startswith("_"):
            kind = re.sub(r"^Annotated\[(\w+),.*", r"\1", str(each.type))
            yield _row(each.name, kind, comments.get(each.name, ""))


def _property(name: str, each: property) -> str:
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(each.fget))).body  # pyright: ignore[reportArgumentType]
    assert isinstance(tree, ast.FunctionDef) and tree.returns is not None
    return _row(name, ast.unparse(tree.returns), " ".join((inspect.getdoc(each) or "").split()))


def _row(name: str, kind: str, text: str) -> str:
    cells = (f"`{name}`", f"`{kind}`", text[:1].upper() + text[1:])
    return f"| {' | '.join(cell.replace('|', chr(92) + '|').replace('<', '&lt;') for cell in cells)} |"


def _paragraphs(documented: Any) -> list[str]:
    return [f"{inspect.getdoc(documented)}\n"]
