"""YAML and changes to it -> a typed, frozen Struct. What the Struct does not know fails, with what it does know.

Defaults and units live in the Structs; a file and the changes hold only what differs. A field whose type is a Plugin
names a module by its `kind`: `camera: {kind: folder, folder: photos}` is capture.cameras.folder and its Config. Further
kinds are installed beside the core (`plugins.py`). A field whose type is a Mapping of Plugins holds several by name,
which is also their kind where they say no other. `config_keys` knows internal keys and former names.
"""

from __future__ import annotations

import dataclasses
import enum
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from typing import Annotated, Any, ClassVar, TypeVar

import msgspec

from splatnode.capture.process.config_keys import (
    KeyPlace,
    find_nearest_key,
    has_fields,
    is_internal,
    join_keys,
    list_documented_keys,
    list_field_types,
    replace_former_name,
)
from splatnode.capture.process.config_text import MAX_BYTES, MAX_DEPTH, ConfigError, parse_yaml
from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.plugins import EntryPoint, entry_points
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

    Modules of the package that lack what `needs` names are no plug-ins. `usual` is the kind where none is named. The
    entry points of `group` name further modules, which lie elsewhere.
    """

    package: ClassVar[str]
    group: ClassVar[str | None] = None
    needs: ClassVar[tuple[str, ...]] = ("Config",)
    usual: ClassVar[str | None] = None
    kind: str
    config: Any  # the module's Config

    @property
    def module(self) -> ModuleType:
        return self.load_module(self.kind)

    @classmethod
    def load_module(cls, kind: str) -> ModuleType:
        """Returns the module of `kind`: a file of the package, or what an entry point names.

        Raises ImportError, or ConfigError where one of another package does not load.
        """
        entry = None if kind in cls._own_names() else cls._entry_points().get(kind)
        if entry is None:
            return import_module(f"{cls.package}.{kind}")
        brought = f"{kind}: the plug-in {entry.target} of {entry.package}"
        try:
            module = entry.load()
        except ImportError as error:
            if entry.is_ours:
                raise
            cause = error.__cause__ or error
            raise ConfigError(
                f"{brought} does not load ({type(cause).__name__}: {sanitize_text(cause)}); install that package anew, "
                "or choose another kind"
            ) from error
        if missing := [needed for needed in cls.needs if not hasattr(module, needed)]:
            both = "both" if len(cls.needs) == 2 else " and ".join(cls.needs)
            raise ConfigError(f"{brought} has no {' and no '.join(missing)}; it must be a module that has {both}")
        return module

    @classmethod
    def kinds(cls) -> list[str]:
        """All there are, those of other packages last. It imports every module of the package, and no entry point's."""
        brought = {name for name, entry in cls._entry_points().items() if not entry.is_ours} - cls._own_names()
        return [name for name in sorted(cls._names() - brought) if cls.is_kind(name)] + sorted(brought)

    @classmethod
    def is_kind(cls, name: object) -> bool:
        """Whether there is a plug-in of this name; no other module is imported."""
        own = cls._own_names()
        if name not in own:
            return name in cls._entry_points()
        module = import_module(f"{cls.package}.{name}")
        return all(hasattr(module, needed) for needed in cls.needs)

    @classmethod
    def _names(cls) -> set[str]:
        return {*cls._own_names(), *cls._entry_points()}

    @classmethod
    def _own_names(cls) -> set[str]:
        return {module.name for module in iter_modules(import_module(cls.package).__path__)}

    @classmethod
    def _entry_points(cls) -> Mapping[str, EntryPoint]:
        return {} if cls.group is None else entry_points(cls.group)


def load_config(path: Path, schema: type[T], changes: Sequence[str] = ()) -> T:
    """The YAML file at `path` with `changes`, such as ["camera.folder=photos"], as a `schema`. Raises ConfigError."""
    return parse_layers([read_yaml(path), parse_changes(changes)], schema)


def parse_layers(layers: Sequence[Mapping[str, Any]], schema: type[T]) -> T:
    """The layers, as people wrote them, each laid over those before it, as a `schema`. Raises ConfigError."""
    tree: dict[str, Any] = {}
    for layer in layers:
        tree = merge_config(tree, replace_former_names(layer, schema, tree))
    return build_config(tree, schema)


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
    """["camera.loops=2", "camera.max-pixels=5"] -> {"camera": {"loops": 2, "max_pixels": 5}}."""
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
    """`raw`, as somebody wrote it, as a `schema`; `where` is the key under which it stands. Raises ConfigError."""
    return build_config(replace_former_names(raw, schema, {}, where), schema, where)


def build_config(raw: Mapping[str, Any], schema: type[T], where: str = "") -> T:
    """`raw`, of present names only, as a `schema` (Struct or dataclass). Raises ConfigError."""
    with guard_untrusted(ConfigError, where):
        try:
            return record_of(_check_keys(raw, schema, where), schema, dec_hook=_decode)
        except msgspec.ValidationError as error:
            message, _, path = str(error).partition(" - at `$")
            below = path.rstrip("`").lstrip(".")
            key = join_keys(where, below)
            if message.startswith(_NO_CHOICE) and (choices := _list_choices(schema, below)):
                got = message.removeprefix(_NO_CHOICE).strip()
                message = f"Expected one of {', '.join(choices)}, got {got}"
            raise ConfigError(
                f"{key or 'configuration'}: {message[0].lower()}{message[1:].replace('`', '')}"
            ) from error


def replace_former_names(
    raw: Mapping[str, Any], schema: type, base: Mapping[str, Any], where: str = ""
) -> dict[str, Any]:
    """`raw`, as somebody wrote it, by present names; `base`, which it changes, has the kinds that it does not say.

    Former and internal keys are told, each once a process. Raises ConfigError where a key has both of its names.
    """
    with guard_untrusted(ConfigError, where):
        return _replace_names(raw, schema, base, KeyPlace(where))


def _replace_names(raw: Any, schema: Any, base: Any, place: KeyPlace) -> Any:
    if not isinstance(raw, Mapping):
        return raw
    base = base if isinstance(base, Mapping) else {}
    if typing.get_origin(schema) is Mapping:
        plugin = typing.get_args(schema)[1]
        return {
            name: _replace_names(each, plugin, base.get(name) or {"kind": name}, dataclasses.replace(place, where=key))
            for name, each in raw.items()
            for key in [join_keys(place.where, str(name))]
        }
    if isinstance(schema, type) and issubclass(schema, Plugin):
        kind = raw.get("kind", base.get("kind", schema.usual))
        if not schema.is_kind(kind):
            return raw  # which is refused where the whole is read
        try:
            module = schema.load_module(str(kind))
        except ConfigError:
            return raw  # likewise
        place, schema = dataclasses.replace(place, kind=str(kind)), module.Config
    if not has_fields(schema):
        return raw
    place, types, result = place.enter(schema), list_field_types(schema), {}
    for key, value in raw.items():
        present = replace_former_name(str(key), place, schema)
        if present != key and present in raw:
            raise ConfigError(f"{join_keys(place.where, present)}: given twice, once as {key}; give it once")
        below = types.get(present)
        inner = _struct_in(below) if present in types else None
        result[present] = _replace_names(value, inner, base.get(present), place.descend(present, is_internal(below)))
    return result


def _check_keys(raw: Any, schema: Any, where: str) -> Any:
    """`raw` after all its keys were found in `schema`, its plug-ins made; types are msgspec's to check."""
    if not isinstance(raw, Mapping):
        return raw
    if typing.get_origin(schema) is Mapping:
        plugin = typing.get_args(schema)[1]
        return {
            name: _check_keys(_add_kind(name, each), plugin, join_keys(where, str(name))) for name, each in raw.items()
        }
    if isinstance(schema, type) and issubclass(schema, Plugin):
        return _plugin(raw, schema, where)
    if not has_fields(schema):
        return raw
    types = typing.get_type_hints(schema)
    unknown = sorted((str(key) for key in raw if key not in types), key=lambda key: key not in OF_VERBS)
    if unknown:
        elsewhere, allowed = _locate_key(unknown[0], types, where), list_documented_keys(schema)
        nearest = None if elsewhere else find_nearest_key(unknown[0], allowed)
        raise ConfigError(
            f"{join_keys(where, sanitize_text(unknown[0]))}: unknown key{elsewhere}; allowed here: {', '.join(allowed)}"
            + (f"; the nearest is {join_keys(where, nearest)}" if nearest else "")
        )
    missing = [name for name in _list_required_fields(schema) if name not in raw]
    if missing:
        raise ConfigError(f"{join_keys(where, missing[0])}: missing; it has no default")
    return {key: _check_keys(value, _struct_in(types[key]), join_keys(where, key)) for key, value in raw.items()}


def _locate_key(key: str, types: Mapping[str, Any], where: str) -> str:
    """Says where a key that is none of these belongs, if one of them has it, or another verb."""
    for name, annotation in types.items():
        struct = _struct_in(annotation)
        if has_fields(struct) and key in typing.get_type_hints(struct):
            return f", which belongs under {join_keys(where, name)}"
    return f", which is of the configuration of {OF_VERBS[key]}" if key in OF_VERBS and not where else ""


def _add_kind(kind: object, raw: Any) -> Any:
    return {"kind": kind, **raw} if isinstance(raw, Mapping) else raw


def _plugin(raw: Mapping[str, Any], schema: type[Plugin], where: str) -> Plugin:
    kind = raw.get("kind", schema.usual)
    if not schema.is_kind(kind):
        known = ", ".join(schema.kinds())
        raise ConfigError(f"{join_keys(where, 'kind')}: expected one of {known}, got {sanitize_text(repr(kind), 100)}")
    try:
        module = schema.load_module(str(kind))
    except ConfigError as error:
        raise ConfigError(f"{join_keys(where, 'kind')}: {error}") from error
    rest = {key: value for key, value in raw.items() if key != "kind"}
    return schema(kind, build_config(rest, module.Config, where))


def _list_required_fields(schema: Any) -> list[str]:
    if issubclass(schema, msgspec.Struct):
        return [field.name for field in msgspec.structs.fields(schema) if field.required]
    none = dataclasses.MISSING
    return [field.name for field in dataclasses.fields(schema) if field.default is none is field.default_factory]


def _struct_in(annotation: Any) -> Any:
    """The Struct or dataclass in `annotation`, also where it may be None; else, and of a Mapping, the annotation."""
    if typing.get_origin(annotation) is Annotated:
        annotation = typing.get_args(annotation)[0]
    if typing.get_origin(annotation) is Mapping:
        return annotation
    return next((choice for choice in typing.get_args(annotation) if has_fields(choice)), annotation)


_NO_CHOICE = "Invalid enum value"  # as msgspec begins what it says of a value that is none of those there are


def _list_choices(schema: Any, path: str) -> list[str]:
    """The values that the key at this path of a `schema` may have; none where it may have others, too."""
    annotation = schema
    for key in path.split("."):
        struct = _struct_in(annotation)
        annotation = typing.get_type_hints(struct).get(key) if has_fields(struct) else None
    return _list_values(annotation)


def _list_values(annotation: Any) -> list[str]:
    if typing.get_origin(annotation) is typing.Literal:
        return [str(value) for value in typing.get_args(annotation)]
    if isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        return [str(each.value) for each in annotation]
    return [value for inner in typing.get_args(annotation) for value in _list_values(inner)]


def _decode(kind: type, value: Any) -> Any:
    """Types that msgspec does not know."""
    if isinstance(value, kind):
        return value
    if kind is Path and isinstance(value, str):
        return Path(value).expanduser()
    raise ValueError(f"Expected {kind.__name__.lower()}, got {type(value).__name__}")
