"""The keys of a configuration: which are internal, which have a former name, and which one was meant.

A field that is marked `Internal[...]`, alone or with all that is nested in it, is a constant of its stage: code may set
it, a file should not, and no page lists it. For one release a file may still hold it; that is told once.

A Struct at the top of a room's configuration may have `former_keys`, the room's table of names that its keys had in the
release before: "section.former" or, of one kind of plug-in alone, "section[kind].former" to the present name.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import logging
import typing
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, TypeVar

import msgspec

from splatnode.capture.process.notices import gives_warnings, notify

log = logging.getLogger(__name__)

T = TypeVar("T")
_NO_NAMES: Mapping[str, str] = {}


class _InternalMark:
    """Marks the type of a field that no file should set."""


INTERNAL = _InternalMark()
Internal = Annotated[T, INTERNAL]


def list_field_types(schema: Any) -> dict[str, Any]:
    """Returns the annotations of the fields of a Struct or dataclass by name, marks and limits included."""
    return typing.get_type_hints(schema, include_extras=True)


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
