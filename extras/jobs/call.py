"""A function of values as a process: what it returned, or why it returned nothing.

The call lies in a folder, `called` is the process, and the answer lies in the same folder.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType
from typing import Any

from splatnode.capture.process import python
from splatnode.capture.process.files import make_owner_only_folder
from splatnode.extras.jobs.child import Child, End

CALL, ANSWER, ERROR, LOG = "call", "answer", "error.txt", "log"  # files of a call's folder

Work = Callable[[], Any]  # that can be pickled: a functools.partial of a module's function


@dataclass(frozen=True)
class Answer:
    """The answer of a call."""

    pickled: bytes | None  # what the function returned; None: nothing
    reason: str  # why it returned nothing: a sentence, or what it raised with its traceback; else empty
    end: End  # of its process

    def value(self) -> Any:
        """Returns the function's result. Raises RuntimeError with the reason where there is none."""
        if self.pickled is None:
            raise RuntimeError(self.reason)
        return pickle.loads(self.pickled)


def pack_call(work: Work) -> bytes:
    """A call for any machine with this splatnode: where the modules of the call are found, the function's, the call."""
    packed = io.BytesIO()
    pickler = _Pickler(packed)
    pickler.dump(work)
    places = sorted(filter(None, {python.place_of(module) for module in pickler.modules}))
    module = getattr(work, "func", work).__module__
    return pickle.dumps(places) + pickle.dumps(module) + packed.getvalue()


class _Pickler(pickle.Pickler):
    """Notes the modules of all functions and classes that it writes."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.modules: set[str] = set()

    def persistent_id(self, obj: object) -> None:
        if isinstance(obj, (FunctionType, type)):
            self.modules.add(obj.__module__)


def write_call(call: bytes, folder: Path) -> Path:
    """Makes the folder of a `pack_call` call, for this user alone. Raises OSError, NotPrivate where it cannot be."""
    make_owner_only_folder(folder, "--out or $TMPDIR", ours=True)
    (folder / CALL).write_bytes(call)
    return folder


def start_call(folder: Path, cores: Sequence[int]) -> Child:
    """A fresh process that makes the call of a folder on `cores`. Raises OSError."""
    return Child.start(python.command("splatnode.extras.jobs.called", str(folder)), folder / LOG, cores)


def answer_of(folder: Path, end: End) -> Answer:
    """The answer of a call whose process has ended; nobody else can put one into the folder of `write_call`."""
    if end.exit_code == 0 and (folder / ANSWER).exists():
        return Answer((folder / ANSWER).read_bytes(), "", end)
    if (folder / ERROR).exists():
        return Answer(None, (folder / ERROR).read_text(), end)
    return Answer(None, end.reason or f"ended with exit code {end.exit_code} and said nothing", end)
