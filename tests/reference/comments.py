"""What a source file says about the fields of a class: the comment at the end of a field's line, or above it."""

from __future__ import annotations

import ast
import inspect
import io
import sys
import textwrap
import tokenize


def field_comments(schema: type) -> dict[str, str]:
    """The comment of each field that has one, by the field's name; those of base classes included."""
    found: dict[str, str] = {}
    for cls in reversed(schema.__mro__):
        if "__annotations__" in vars(cls):
            found |= _of_source(textwrap.dedent(inspect.getsource(cls)))
    return found


def summary(documented: type) -> str:
    """The first paragraph of the docstring of a class; where it has none, of the module that it stands in."""
    own = documented.__doc__ or ""
    if own.startswith(f"{documented.__name__}("):  # that of a dataclass which has none
        own = ""
    text = own or sys.modules[documented.__module__].__doc__ or ""
    return " ".join(inspect.cleandoc(text).split("\n\n")[0].split())


def _of_source(source: str) -> dict[str, str]:
    (cls,) = ast.parse(source).body
    assert isinstance(cls, ast.ClassDef)
    fields = [node for node in cls.body if isinstance(node, ast.AnnAssign)]
    comments = _by_line(source)
    lines = source.splitlines()
    said = {ast.unparse(field.target): _beside(field, comments) or _above(field, comments, lines) for field in fields}
    return {name: text for name, text in said.items() if text}


def _by_line(source: str) -> dict[int, str]:
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}


def _beside(field: ast.AnnAssign, comments: dict[int, str]) -> str:
    lines = range(field.lineno, (field.end_lineno or field.lineno) + 1)
    return " ".join(comments[line] for line in lines if line in comments)


def _above(field: ast.AnnAssign, comments: dict[int, str], lines: list[str]) -> str:
    """The lines directly above that are nothing but comment."""
    first = field.lineno
    while first - 1 in comments and lines[first - 2].lstrip().startswith("#"):
        first -= 1
    return " ".join(comments[line] for line in range(first, field.lineno))
