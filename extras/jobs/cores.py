"""The cores that this process may use, and which of them is free of other work of this user."""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from splatnode.capture.process.files import make_owner_only_folder


def usable_cores() -> tuple[int, ...]:
    """Their numbers, rising."""
    return tuple(sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1))


def chosen_cores(wanted: int | None) -> tuple[int, ...]:
    """The first `wanted` of them; None: all. Raises ValueError where there are fewer."""
    allowed = usable_cores()
    if wanted is not None and wanted > len(allowed):
        raise ValueError(f"--cores must be at most {len(allowed)}, which this process may use; got {wanted}")
    return allowed[:wanted]


@contextlib.contextmanager
def free_core() -> Iterator[int]:
    """A core that no other work is on, of whatever worker of this user; where none is, the one with this turn."""
    cores = usable_cores()
    folder = Path(tempfile.gettempdir(), f"splatnode-cores-{os.getuid()}")
    make_owner_only_folder(folder, "$TMPDIR", ours=True)
    for core in cores:
        with (folder / str(core)).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield core
            return
    yield cores[os.getpid() % len(cores)]
