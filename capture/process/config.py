"""YAML and changes to it -> a typed, frozen Struct. What the Struct does not know fails, with what it does know.

Defaults and units live in the Structs; a file and the changes hold only what differs. A field whose type is a Plugin
names a module by its `kind`: `camera: {kind: folder, folder: photos}` is capture.cameras.folder and its Config. Further
kinds are installed beside the core (`plugins.py`). A field whose type is a Mapping of Plugins holds several by name,
which is also their kind where they say no other.
"""

from __future__ import annotations

import dataclasses
import difflib
import enum
import functools
import logging
import math
import re
import threading
import typing
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import MappingProxyType, ModuleType
from typing import Annotated, Any, ClassVar, TypeVar

import msgspec
import yaml

from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.plugins import EntryPoint, entry_points
from splatnode.capture.process.terminal import gives_warnings, notify
from splatnode.capture.process.text import MAX_NUMBER, guard_untrusted, sanitize_text

# Records out of JSON and of plain values, in any thread.
#
# msgspec learns a type when it first meets it, and keeps what it has learnt with the type before it knows all of it.
# Two threads that meet a type at once can end the process (segmentation fault, msgspec 0.22), so they take turns.

Decoder = msgspec.msgpack.Decoder
_TURN = threading.RLock()
_TOO_DEEP = "values may not be nested as deeply as these"


def record_of(value: Any, kind: Any, dec_hook: Callable[[type, Any], Any] | None = None) -> Any:
    """`msgspec.convert`: the plain `value` as a `kind`. Raises msgspec.ValidationError, and nothing else."""
    with _TURN:
        try:
            return msgspec.convert(value, kind, dec_hook=dec_hook)
        except RecursionError as error:
            raise msgspec.ValidationError(_TOO_DEEP) from error


def record_in(data: bytes | str, kind: Any) -> Any:
    """`msgspec.json.decode`: the `kind` in JSON.

    Raises msgspec.DecodeError, msgspec.ValidationError, and nothing else: msgspec itself has further errors for a text
    that is no UTF-8 and for one that is nested deeply.
    """
    with _TURN:
        try:
            return msgspec.json.decode(data, type=kind)
        except RecursionError as error:
            raise msgspec.DecodeError(_TOO_DEEP) from error
        except UnicodeError as error:
            raise msgspec.DecodeError(f"JSON is UTF-8: {error}") from error


def decoder_of(kind: Any) -> Decoder:
    """A decoder of MessagePack, which threads may share."""
    with _TURN:
        return Decoder(kind)


# The text of a configuration -> values, of which there are not more, nor deeper or larger ones, than anybody writes.
#
# YAML can say much in few bytes: an alias repeats what it names, a number has as many digits as it likes. All limits
# hold while the text is read, before anything is made of it.

MAX_BYTES = 262_144  # of a file
MAX_VALUES = 10_000  # keys count, too
MAX_DEPTH = 32
MAX_CHARACTERS = 4096  # of a text, such as a path
_MAX_DIGITS = 64


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the key, what was expected and what came."""


def parse_yaml(text: str, source: str) -> Any:
    """The value in `text`, one YAML document; None where there is none. Raises ConfigError, which names `source`.

    It consists of mappings with different keys that are text, lists, finite numbers, text, truth values and None.
    """
    with guard_untrusted(ConfigError, source):
        if len(text) > MAX_BYTES:
            raise ConfigError(f"{source}: {len(text)} characters; at most {MAX_BYTES} are read")
        try:
            return yaml.load(text, Loader=_Loader)  # a SafeLoader
        except yaml.YAMLError as error:
            raise ConfigError(f"{source} is not YAML: {error}") from error
        except _BoundsError as error:
            raise ConfigError(f"{source}: {error}") from error


class _BoundsError(Exception):
    """A value that no configuration has."""

    def __init__(self, expected: str, node: yaml.Node) -> None:
        text = node.value if isinstance(node, yaml.ScalarNode) else type(node).__name__
        super().__init__(f"line {node.start_mark.line + 1}: {expected}, got {sanitize_text(text, 100)}")


class _Loader(yaml.SafeLoader):
    """YAML 1.1 as PyYAML reads it, but 1e-3 is a number, as it is in YAML 1.2. Raises _Beyond, yaml.YAMLError."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = self._values = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError(f"line {event.start_mark.line + 1}: aliases (*) are not read; write the value out")
        self._depth, self._values = self._depth + 1, self._values + 1
        if self._depth > MAX_DEPTH or self._values > MAX_VALUES:
            line = event.start_mark.line + 1
            raise yaml.YAMLError(f"line {line}: more than {MAX_VALUES} values, or deeper than {MAX_DEPTH}")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_text(self, node: yaml.ScalarNode) -> str:
        # Control characters and halves of letters are in no path, and would end what opens it.
        categories = {unicodedata.category(letter) for letter in node.value}
        if len(node.value) > MAX_CHARACTERS or categories & {"Cc", "Cs"}:
            raise _BoundsError(f"expected a text of one line, of at most {MAX_CHARACTERS} characters", node)
        return node.value

    def construct_number(self, node: yaml.ScalarNode) -> float:
        construct = self.construct_yaml_int if node.tag.endswith(":int") else self.construct_yaml_float
        number = construct(node) if len(node.value) <= _MAX_DIGITS else math.nan
        if not abs(number) <= MAX_NUMBER:
            raise _BoundsError(f"expected a number within ±{MAX_NUMBER}", node)
        return number

    def distinct_keys(self, node: yaml.MappingNode) -> dict[str, Any]:
        keys = [key.value if key.tag == "tag:yaml.org,2002:str" else None for key, _ in node.value]
        if None in keys or len({*keys}) < len(keys):
            raise _BoundsError("expected keys that are text and differ", node)
        return {self.construct_object(key): self.construct_object(value, deep=True) for key, value in node.value}


_TAG = "tag:yaml.org,2002:"
_Loader.add_implicit_resolver(
    f"{_TAG}float", re.compile(r"^[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)
_Loader.yaml_constructors = {
    f"{_TAG}null": _Loader.construct_yaml_null,
    f"{_TAG}bool": _Loader.construct_yaml_bool,
    f"{_TAG}int": _Loader.construct_number,
    f"{_TAG}float": _Loader.construct_number,
    f"{_TAG}str": _Loader.construct_text,
    f"{_TAG}timestamp": _Loader.construct_text,  # a folder may be called 2020-01-01
    f"{_TAG}seq": lambda loader, node: loader.construct_sequence(node, deep=True),
    f"{_TAG}map": _Loader.distinct_keys,
    None: _Loader.construct_undefined,
}


# The keys of a configuration: which are internal, which have a former name, and which one was meant.
#
# A field that is marked `Internal[...]`, alone or with all that is nested in it, is a constant of its stage: code may
# set it, a file should not, and no page lists it. For one release a file may still hold it; that is told once.
#
# A Struct at the top of a room's configuration may have `former_keys`, the room's table of names that its keys had in
# the release before: "section.former" or, of one kind of plug-in alone, "section[kind].former" to the present name.

log = logging.getLogger(__name__)

T = TypeVar("T")
_NO_NAMES: Mapping[str, str] = {}


class _InternalMark:
    """Marks the type of a field that no file should set."""


INTERNAL = _InternalMark()
Internal = Annotated[T, INTERNAL]


@functools.cache  # Python evaluates the annotations each time that it is asked
def list_field_types(schema: Any) -> Mapping[str, Any]:
    """Returns the annotations of the fields of a Struct or dataclass by name, marks and limits included."""
    return MappingProxyType(typing.get_type_hints(schema, include_extras=True))


@functools.cache
def _list_plain_types(schema: Any) -> Mapping[str, Any]:
    """As `list_field_types`, without marks and limits."""
    return MappingProxyType(typing.get_type_hints(schema))


def is_internal(annotation: Any) -> bool:
    """Returns whether a field of this type is one that no file should set."""
    return typing.get_origin(annotation) is Annotated and INTERNAL in annotation.__metadata__


def list_documented_keys(schema: Any) -> list[str]:
    """Returns the names of the fields that files may set."""
    return [name for name, annotation in list_field_types(schema).items() if not is_internal(annotation)]


def find_nearest_key(key: str, keys: Iterable[str]) -> str | None:
    """Returns the key that was probably meant by one that does not exist, or None."""
    return next(iter(difflib.get_close_matches(key, [*keys], n=1)), None)


@dataclasses.dataclass(frozen=True)
class KeyPlace:
    """The place of a Struct: its path in the file, for people, and in the room's table of former names."""

    where: str = ""
    section: str = ""
    kind: str = ""  # of the plug-in that the Struct configures
    former: Mapping[str, str] = dataclasses.field(default_factory=lambda: _NO_NAMES)
    internal: bool = False  # something above is internal, which has been told

    def enter(self, schema: Any) -> KeyPlace:
        """Returns the place of a Struct in itself: its room's table holds from there on, if it has one."""
        former = getattr(schema, "former_keys", None)
        return self if former is None else dataclasses.replace(self, section="", kind="", former=former)

    def descend(self, key: str, internal: bool) -> KeyPlace:
        """Returns the place of what stands under `key`."""
        return KeyPlace(
            join_keys(self.where, key),
            join_keys(self.section, key),
            "",
            self.former,
            self.internal or internal,
        )

    def find_present_name(self, key: str) -> str | None:
        """Returns the present name of a former key, or None where it never was one."""
        of_kind = self.former.get(f"{self.section}[{self.kind}].{key}") if self.kind else None
        return of_kind or self.former.get(join_keys(self.section, key))


def replace_former_name(key: str, place: KeyPlace, schema: Any) -> str:
    """Returns the present name of a key that somebody wrote; a former or an internal one is told once a process."""
    types = list_field_types(schema)
    present = key if key in types else place.find_present_name(key)
    if present is None or present not in types:
        return key  # an unknown key, which is refused where the whole is read
    if present != key:
        _tell_of_key(
            f"{join_keys(place.where, key)} is called {present} now; write {join_keys(place.where, present)}: "
            "the former name is read in this release only"
        )
    if is_internal(types[present]) and not place.internal:
        _tell_of_key(
            f"{join_keys(place.where, present)} is internal: it will be a constant in the next release; leave it out"
        )
    return present


def has_fields(schema: Any) -> bool:
    """Returns whether it is a Struct or a dataclass."""
    return isinstance(schema, type) and (issubclass(schema, msgspec.Struct) or dataclasses.is_dataclass(schema))


def join_keys(where: str, key: str) -> str:
    """Returns the path of `key` under `where`, either of which may be empty."""
    return f"{where}.{key}" if where and key and not key.startswith("[") else where + key


def _tell_of_key(text: str) -> None:
    """On the log once a process; a program's filters tell how often it hears a Python warning."""
    if gives_warnings():
        notify(log, text, DeprecationWarning)
    else:
        _warn_once(text)


@functools.cache
def _warn_once(text: str) -> None:
    log.warning(text)


# A configuration: what a file and the changes to it say, as a Struct.

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
    types = _list_plain_types(schema)
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
        if has_fields(struct) and key in _list_plain_types(struct):
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


@functools.cache
def _list_required_fields(schema: Any) -> Sequence[str]:
    if issubclass(schema, msgspec.Struct):
        return tuple(field.name for field in msgspec.structs.fields(schema) if field.required)
    none = dataclasses.MISSING
    return tuple(field.name for field in dataclasses.fields(schema) if field.default is none is field.default_factory)


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
        annotation = _list_plain_types(struct).get(key) if has_fields(struct) else None
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
