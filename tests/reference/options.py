"""All options under a configuration's type: sections in the order of the code, each with its options."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from splatnode.capture.process.config import Plugin, has_fields, is_internal, list_field_types
from tests.reference.comments import field_comments, summary

REQUIRED = object()  # in place of a default where there is none
_WORDS = {bool: "true or false", int: "whole number", float: "number", str: "text", Path: "path"}


@dataclass(frozen=True)
class Option:
    name: str  # with dots, from the top of the file
    default: Any  # REQUIRED where there is none
    values: str  # kind and range
    text: str  # empty where the code says nothing


@dataclass(frozen=True)
class Section:
    name: str  # of its options without their last part; empty at the top
    kind: str  # of the plug-in that the options belong to; empty for what is no plug-in
    text: str
    options: tuple[Option, ...]


def sections(
    schema: type, default: Any = REQUIRED, name: str = "", text: str = "", kind: str = "", internal: bool = False
) -> Iterator[Section]:
    """The section of a Struct or dataclass, then those of what is nested in it; with `internal`, of internal keys, too.

    `default` is an instance that the defaults are of; without it they are those of the class. `text` says what the
    section is for; without it the docstring of the class or of its module does.
    """
    comments, defaults = field_comments(schema), _defaults(schema, default)
    options, nested = [], []
    for field, annotation in list_field_types(schema).items():
        if is_internal(annotation) and not internal:
            continue
        path, said, value = _join(name, field), comments.get(field, ""), defaults[field]
        inner = _inner(annotation)
        if inner is None:
            options.append(Option(path, value, values(annotation), said))
        elif issubclass(inner, Plugin):
            many = typing.get_origin(_bare(annotation)) is Mapping
            path = _join(path, "NAME") if many else path
            options.append(Option(path, value, _kinds(inner, annotation), said or summary(inner)))
            nested += [section for each in inner.kinds() for section in _plugin(path, inner, each, value, internal)]
        elif _is_list(annotation):
            options.append(Option(path, value, "list, its entries below", said or summary(inner)))
            nested += sections(inner, name=f"{path}[]", internal=internal)
        else:
            if value is None:
                options.append(Option(path, value, "its options below or null", said or summary(inner)))
            nested += sections(inner, value, path, "" if value is None else said, internal=internal)
    yield Section(name, kind, text or summary(schema), tuple(options))
    yield from nested


def undescribed(found: Iterator[Section]) -> list[str]:
    """The names of options and sections of which the code does not say what they do."""
    return [each.name for section in found for each in (section, *section.options) if not each.text]


def values(annotation: Any) -> str:
    """What an option may be, with its range, in words."""
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union:
        return " or ".join(values(each) for each in typing.get_args(annotation))
    if annotation is type(None):
        return "null"
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        limits = [_range(meta) for meta in annotation.__metadata__ if isinstance(meta, msgspec.Meta)]
        return " ".join([values(arguments[0]), *filter(None, limits)])
    if origin is Literal:
        return " or ".join(map(str, arguments))
    if origin is tuple and arguments[-1] is ...:
        return f"list, each a {values(arguments[0])}"
    if origin is tuple:
        return f"list: {', '.join(map(values, arguments))}"
    if hasattr(annotation, "_fields"):  # a NamedTuple
        return f"list: {', '.join(annotation._fields)}"
    return _WORDS[annotation]


def _range(meta: msgspec.Meta) -> str:
    least = _number(meta.ge) if meta.ge is not None else f"above {_number(meta.gt)}" if meta.gt is not None else None
    most = _number(meta.le) if meta.le is not None else f"below {_number(meta.lt)}" if meta.lt is not None else None
    if least and most:
        return f"{least} to {most}"
    return f"up to {most}" if most else f"from {least}" if meta.ge is not None else least or ""


def _number(bound: float) -> str:
    """The bound, whole numbers without a point: `typing` gives 1e6 for 1000000 where it met that first."""
    return str(int(bound)) if float(bound).is_integer() and abs(bound) < 1e15 else str(bound)


def _kinds(plugin: type[Plugin], annotation: Any) -> str:
    kinds = f"kind: {' or '.join(plugin.kinds())}"
    return f"{kinds}; or null" if type(None) in typing.get_args(annotation) else kinds


def _plugin(path: str, plugin: type[Plugin], kind: str, value: Any, internal: bool) -> Iterator[Section]:
    """The sections of one kind; the defaults are those of the plug-in that is the default, where it is of this kind."""
    module = plugin.load_module(kind)
    chosen = isinstance(value, Plugin) and value.kind == kind
    text = (module.__doc__ or "").split("\n\n")[0]
    default = value.config if chosen else REQUIRED
    return sections(module.Config, default, path, " ".join(text.split()), kind, internal)


def _defaults(schema: type, instance: Any) -> dict[str, Any]:
    if isinstance(instance, schema):
        return {field: getattr(instance, field) for field in typing.get_type_hints(schema)}
    if issubclass(schema, msgspec.Struct):
        given = {field.name: (field.default, field.default_factory) for field in msgspec.structs.fields(schema)}
        none = msgspec.NODEFAULT
    else:
        given = {field.name: (field.default, field.default_factory) for field in dataclasses.fields(schema)}
        none = dataclasses.MISSING
    return {
        name: value if value is not none else make() if make is not none else REQUIRED
        for name, (value, make) in given.items()
    }


def _bare(annotation: Any) -> Any:
    """The annotation without None, and without limits and marks."""
    if typing.get_origin(annotation) is Annotated:
        annotation = typing.get_args(annotation)[0]
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union:
        annotation = next(each for each in typing.get_args(annotation) if each is not type(None))
    return typing.get_args(annotation)[0] if typing.get_origin(annotation) is Annotated else annotation


def _inner(annotation: Any) -> type | None:
    """The type with fields of its own that the option holds, alone or several of it; None where it holds none."""
    bare = _bare(annotation)
    choices = (bare, *typing.get_args(bare))
    return next((each for each in choices if isinstance(each, type) and has_fields(each)), None)


def _is_list(annotation: Any) -> bool:
    return typing.get_origin(_bare(annotation)) is tuple


def _join(name: str, field: str) -> str:
    return f"{name}.{field}" if name else field
