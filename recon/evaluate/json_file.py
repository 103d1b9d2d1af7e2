"""JSON files of evaluations: true cameras, splits, raw results."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec

from splatnode.capture.process.bounded_file import read_bounded
from splatnode.capture.process.foreign import guard_untrusted
from splatnode.capture.process.records import record_in

T = TypeVar("T")

MAX_BYTES = 500_000_000


class EvaluationFileError(ValueError):
    """A file of an evaluation that is not what it should be; the message names it."""


def read_json(path: Path, kind: type[T], expected: str) -> T:
    """The content of `path`, which must be `expected`, as a `kind`; numbers are finite.

    Raises EvaluationFileError, OSError.
    """
    with guard_untrusted(EvaluationFileError, str(path)):
        try:
            return record_in(read_bounded(path, MAX_BYTES, EvaluationFileError, str(path)), kind)
        except msgspec.MsgspecError as error:
            raise EvaluationFileError(f"{path} must be {expected}: {error}") from error
