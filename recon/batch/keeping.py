"""Names in the folder of a batch, and how a result gets its own: whole, in place of an earlier one, or not at all."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

from splatnode.recon.batch.answer import Outcome, read_outcome
from splatnode.recon.batch.sources import BatchRecording
from splatnode.recon.jobs.child import End

LOG = "replay.log"  # in a result folder: what its process said; of one that failed NAME.log, beside the results
PARTIAL = ".partial"  # the end of a hidden name, of what is being made
_OLD = ".old"


def partial_folder(out: Path, name: str) -> Path:
    """Returns the folder in which the result `name` is made."""
    return out / f".{name}{PARTIAL}"


def partial_log(out: Path, name: str) -> Path:
    return out / f".{name}.log{PARTIAL}"


def finalize_result(recording: BatchRecording, out: Path, made_as: str, end: End) -> Outcome:
    """Gives the result that was made as `partial_folder(out, made_as)` its name; of a failure what was said is kept."""
    partial, log = partial_folder(out, made_as), partial_log(out, made_as)
    found, final, failed_log = (
        read_outcome(recording, partial, end),
        out / recording.name,
        out / f"{recording.name}.log",
    )
    if found.has_failed:
        os.replace(log, failed_log)
        shutil.rmtree(partial, ignore_errors=True)
        return found
    failed_log.unlink(missing_ok=True)
    os.replace(log, partial / LOG)
    while not _replace_result(partial, final, partial_folder(out, made_as + _OLD)):
        continue
    return found


def _replace_result(partial: Path, final: Path, old: Path) -> bool:
    """Whether `partial` has its name now; not where another run of the same recording was just faster.

    What is there is left by a driver that was killed before it could write the outcome down, or was run again.
    """
    try:
        if final.exists():
            os.replace(final, old)
        os.replace(partial, final)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOENT) or not partial.exists():
            raise
        return False
    finally:
        shutil.rmtree(old, ignore_errors=True)
    return True


def remove_leftovers(out: Path) -> None:
    """Removes what processes that are no more had begun."""
    with os.scandir(out) as entries:
        leftovers = [Path(entry.path) for entry in entries if entry.name[0] == "." and entry.name.endswith(PARTIAL)]
    for path in leftovers:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
