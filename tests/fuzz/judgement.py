"""What counts as good: values that are finite and show, or a refusal that is documented and is one line."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterable, Mapping
from typing import Any

import msgspec
import numpy as np

from splatnode.capture.process.config import ConfigError
from splatnode.capture.process.text import LONGEST_LINE, sanitize_lines
from splatnode.command_line import exit_code, explain

MOST_SECONDS = 1.0  # of processor time, for one case
MOST_MB = 256.0  # of memory, for one case
_DEEPEST = 12
_INTERNAL = 70  # the exit code of what nobody foresaw
_MOST_LINES = 30  # of a configuration's error, which shows where in the file it is


def problem_of_value(value: Any, printed: bool, where: str = "value", depth: int = 0) -> str:
    """Where in what was read a number is not finite, or a text does not only show; empty where all is well."""
    if isinstance(value, float):
        return "" if math.isfinite(value) else f"{where} is {value}"
    if isinstance(value, str):
        return f"{where} is not printable: {value[:60]!a}" if printed and not value.isprintable() else ""
    if value is None or isinstance(value, (int, bytes, os.PathLike)) or depth > _DEEPEST:
        return ""
    if isinstance(value, np.ndarray):
        fine = value.dtype.kind not in "fc" or bool(np.isfinite(value).all())
        return "" if fine else f"{where} {value.shape} is not finite"
    for name, each in _contents(value):
        if problem := problem_of_value(each, printed, f"{where}{name}", depth + 1):
            return problem
    return ""


def _contents(value: Any) -> Iterable[tuple[str, Any]]:
    if isinstance(value, Mapping):
        return [(f"[{key!a}]", part) for key, part in value.items()] + [(" key", key) for key in value]
    if isinstance(value, (list, tuple, set, frozenset)):
        return [(f"[{index}]", part) for index, part in enumerate(value)]
    if isinstance(value, msgspec.Struct):
        return [(f".{name}", getattr(value, name)) for name in value.__struct_fields__]
    if dataclasses.is_dataclass(value):
        return [(f".{field.name}", getattr(value, field.name)) for field in dataclasses.fields(value)]
    return ()


def problem_of_refusal(error: BaseException) -> str:
    """What is wrong with how a refusal is told; empty where nothing is."""
    code = exit_code(error)
    text = explain(error, code) if isinstance(error, Exception) else sanitize_lines(error)
    lines = text.split("\n")
    if code == _INTERNAL and isinstance(error, (ValueError, OSError)):
        return f"it is called an internal error: {text[:200]}"
    if len(lines) > (_MOST_LINES if isinstance(error, ConfigError) else 1):
        return f"it has {len(lines)} lines: {text[:200]!a}"
    if not text.strip() or max(map(len, lines)) > LONGEST_LINE:
        return f"it has {len(text)} characters: {text[:100]!a}"
    if not all(line.isprintable() for line in lines):
        return f"it is not printable: {text[:200]!a}"
    return ""
