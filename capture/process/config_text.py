"""The text of a configuration -> values, of which there are not more, nor deeper or larger ones, than anybody writes.

YAML can say much in few bytes: an alias repeats what it names, a number has as many digits as it likes. All limits hold
while the text is read, before anything is made of it.
"""

from __future__ import annotations

import math
import re
import unicodedata
from typing import Any

import yaml

from splatnode.capture.process.text import guard_untrusted, sanitize_text

MAX_BYTES = 262_144  # of a file
MAX_VALUES = 10_000  # keys count, too
MAX_DEPTH = 32
MAX_CHARACTERS = 4096  # of a text, such as a path
MAX_NUMBER = 2**31  # either side of 0
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
