"""YAML and changes to it -> a typed, frozen Struct. What the Struct does not know fails, with what it does know.

Defaults and units live in the Structs; a file and the changes hold only what differs. A field whose type is a Plugin
names a module by its `kind`: `camera: {kind: folder, folder: photos}` is capture.cameras.folder and its Config. A field
whose type is a Mapping of Plugins holds several by name, which is also their kind where they say no other.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from typing import Any, ClassVar, TypeVar

import msgspec

from splatnode.capture.process.config_text import MAX_BYTES, MAX_DEPTH, ConfigError, parse_yaml
from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.records import record_of
from splatnode.capture.process.text import guard_untrusted, sanitize_text

T = TypeVar("T")

OF_VERBS = {  # keys by which a file is known that was given to another verb
    "camera": "splatnode capture",
    "reconstruction": "splatnode recon",
}


@dataclass(frozen=True)
class Plugin:
    """A module of `package`, chosen by `kind`, with its Config. A room subclasses it and names the package.

    Modules of the package that lack what `needs` names are no plug-ins. `usual` is the kind where none is named.
    """

    package: ClassVar[str]
    needs: ClassVar[tuple[str, ...]] = ("Config",)
    usual: ClassVar[str | None] = None
    entry_points: ClassVar[str | None] = None  # the group by which other packages bring plug-ins; None: none may
    kind: str
    config: Any  # the module's Config

    @property
    def module(self) -> ModuleType:
        return self.load_module(self.kind)

    @classmethod
    def load_module(cls, kind: str) -> ModuleType:
        """The module of a kind that there is. Raises ConfigError where one of another package does not load."""
        if kind in cls._names():
            return import_module(f"{cls.package}.{kind}")
        point, *others = entry_points(group=cls.entry_points or "", name=kind)
        if others:
            raise ConfigError(f"{kind}: several packages bring a plug-in of this name; uninstall all but one of them")
        brought = f"{kind}: the plug-in {point.value}{f' of {point.dist.name}' if point.dist else ''}"
        try:
            module = point.load()
        except Exception as error:  # it is another's code
            raise ConfigError(
                f"{brought} does not load ({type(error).__name__}: {sanitize_text(error)}); install that package anew, "
                "or choose another kind"
            ) from error
        missing = [needed for needed in cls.needs if not hasattr(module, needed)]
        if missing:
            raise ConfigError(f"{brought} has no {' and no '.join(missing)}; it must be a module that has both")
        return module

    @classmethod
    def kinds_elsewhere(cls) -> list[str]:
        """The names of plug-ins that other packages bring; none of them is imported. Ours count before theirs."""
        found = entry_points(group=cls.entry_points) if cls.entry_points else ()
        return sorted({point.name for point in found}.difference(cls._names()))

    @classmethod
    def kinds(cls) -> list[str]:
        """All there are. It imports every module of the package, to see what each has."""
        return [name for name in cls._names() if cls.is_kind(name)]

    @classmethod
    def is_kind(cls, name: object) -> bool:
        """Whether there is a plug-in of this name; no other module is imported."""
        if name not in cls._names():
            return False
        module = import_module(f"{cls.package}.{name}")
        return all(hasattr(module, needed) for needed in cls.needs)

    @classmethod
    def _names(cls) -> list[str]:
        return sorted(module.name for module in iter_modules(import_module(cls.package).__path__))


def load_config(path: Path, schema: type[T], changes: Sequence[str] = ()) -> T:
    """The YAML file at `path` with `changes`, such as ["camera.folder=photos"], as a `schema`. Raises ConfigError."""
    return parse_config(merge_config(read_yaml(path), parse_changes(changes)), schema)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; empty for an empty file. Raises ConfigError."""
    try:
        text = read_bounded(path, MAX_BYTES, ConfigError, str(path)).decode()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; give a YAML file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not YAML: {error}") from error
    content = parse_yaml(text, str(path))
    if content is not None and not isinstance(content, dict):
        raise ConfigError(f"{path}: expected keys and values, got {type(content).__name__}")
    return content or {}


def parse_changes(changes: Sequence[str]) -> dict[str, Any]:
    """["camera.loops=2", "camera.frames-per-second=5"] -> {"camera": {"loops": 2, "frames_per_second": 5}}."""
    tree: dict[str, Any] = {}
    for change in changes:
        key, equals, value = change.partition("=")
        names = key.replace("-", "_").split(".")
        if not (key and equals and len(names) <= MAX_DEPTH):
            raise ConfigError(f"expected KEY=VALUE such as camera.loops=2, got {sanitize_text(change)!r}")
        leaf = parse_yaml(value, sanitize_text(key))
        for name in reversed(names):
            leaf = {name: leaf}
        tree = merge_config(tree, leaf)
    return tree


def merge_config(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with `changes` laid over it, key by key."""
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        result[key] = merge_config(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return result


def parse_config(raw: Mapping[str, Any], schema: type[T], where: str = "") -> T:
    """`raw` as a `schema` (Struct or dataclass); `where` is the key under which it stands. Raises ConfigError."""
    with guard_untrusted(ConfigError, where):
        try:
            return record_of(_check_keys(raw, schema, where), schema, dec_hook=_decode)
        except msgspec.ValidationError as error:
            message, _, path = str(error).partition(" - at `$")
            key = _join(where, path.rstrip("`").lstrip("."))
            raise ConfigError(
                f"{key or 'configuration'}: {message[0].lower()}{message[1:].replace('`', '')}"
            ) from error


def _check_keys(raw: Any, schema: Any, where: str) -> Any:
    """`raw` after all its keys were found in `schema`, its plug-ins made; types are msgspec's to check."""
    if not isinstance(raw, Mapping):
        return raw
    if typing.get_origin(schema) is Mapping:
        plugin = typing.get_args(schema)[1]
        return {name: _check_keys(_add_kind(name, each), plugin, _join(where, str(name))) for name, each in raw.items()}
    if isinstance(schema, type) and issubclass(schema, Plugin):
        return _plugin(raw, schema, where)
    if not _has_fields(schema):
        return raw
    types = typing.get_type_hints(schema)
    unknown = sorted((str(key) for key in raw if key not in types), key=lambda key: key not in OF_VERBS)
    if unknown:
        elsewhere = _locate_key(unknown[0], types, where)
        raise ConfigError(
            f"{_join(where, sanitize_text(unknown[0]))}: unknown key{elsewhere}; allowed here: {', '.join(types)}"
        )
    missing = [name for name in _list_required_fields(schema) if name not in raw]
    if missing:
        raise ConfigError(f"{_join(where, missing[0])}: missing; it has no default")
    return {key: _check_keys(value, _struct_in(types[key]), _join(where, key)) for key, value in raw.items()}


def _locate_key(key: str, types: Mapping[str, Any], where: str) -> str:
    """Says where a key that is none of these belongs, if one of them has it, or another verb."""
    for name, annotation in types.items():
        struct = _struct_in(annotation)
        if _has_fields(struct) and key in typing.get_type_hints(struct):
            return f", which belongs under {_join(where, name)}"
    return f", which is of the configuration of {OF_VERBS[key]}" if key in OF_VERBS and not where else ""


def _add_kind(kind: object, raw: Any) -> Any:
    return {"kind": kind, **raw} if isinstance(raw, Mapping) else raw


def _plugin(raw: Mapping[str, Any], schema: type[Plugin], where: str) -> Plugin:
    kind = raw.get("kind", schema.usual)
    elsewhere = schema.kinds_elsewhere()
    if not (kind in elsewhere or schema.is_kind(kind)):
        known = ", ".join([*schema.kinds(), *elsewhere])
        raise ConfigError(f"{_join(where, 'kind')}: expected one of {known}, got {sanitize_text(repr(kind), 100)}")
    try:
        module = schema.load_module(str(kind))
    except ConfigError as error:
        raise ConfigError(f"{_join(where, 'kind')}: {error}") from error
    rest = {key: value for key, value in raw.items() if key != "kind"}
    return schema(kind, parse_config(rest, module.Config, where))


def _has_fields(schema: Any) -> bool:
    return isinstance(schema, type) and (issubclass(schema, msgspec.Struct) or dataclasses.is_dataclass(schema))


def _list_required_fields(schema: Any) -> list[str]:
    if issubclass(schema, msgspec.Struct):
        return [field.name for field in msgspec.structs.fields(schema) if field.required]
    none = dataclasses.MISSING
    return [field.name for field in dataclasses.fields(schema) if field.default is none is field.default_factory]


def _struct_in(annotation: Any) -> Any:
    """The Struct or dataclass in `annotation`, also where it may be None; else, and of a Mapping, the annotation."""
    if typing.get_origin(annotation) is Mapping:
        return annotation
    return next((choice for choice in typing.get_args(annotation) if _has_fields(choice)), annotation)


def _decode(kind: type, value: Any) -> Any:
    """Types that msgspec does not know."""
    if isinstance(value, kind):
        return value
    if kind is Path and isinstance(value, str):
        return Path(value).expanduser()
    raise ValueError(f"Expected {kind.__name__.lower()}, got {type(value).__name__}")


def _join(where: str, key: str) -> str:
    return f"{where}.{key}" if where and key and not key.startswith("[") else where + key
