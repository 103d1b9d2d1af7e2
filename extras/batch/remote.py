"""One recording on a worker of a cluster: a function of values, whose result is whole in a shared folder or a store.

It may run more than once for one recording, after a worker or a machine is lost, and even twice at a time: each run
makes its result under a name of its own, and the last one counts, which is the same to the bit.
"""

from __future__ import annotations

import shutil
import tempfile
import uuid
from dataclasses import dataclass
from pathlib import Path

from splatnode.extras.batch.batch import (
    REPORT,
    BatchRecording,
    Outcome,
    Work,
    finalize_result,
    make_failed_outcome,
    partial_folder,
    partial_log,
)
from splatnode.extras.jobs.child import NOT_RUN, Child, Limits, wait_for_end
from splatnode.extras.jobs.cores import free_core
from splatnode.extras.jobs.version import other_version

_OF_STORE = "://"  # in the address of an object store


@dataclass(frozen=True)
class Job:
    """The settings that all recordings of a batch share."""

    work: Work  # that can be pickled: a function of a module, or a partial of one
    results: str  # a folder that all workers share, or an address that fsspec knows, such as s3://bucket/run
    limits: Limits
    version: str  # of the splatnode that began the batch


def run_recording(recording: BatchRecording, job: Job) -> Outcome:
    """Runs it on a core of this machine that no other recording is on; the result is in `job.results` then.

    What fails is an outcome. Raises OSError where the results cannot be written.
    """
    if (other := other_version(job.version)) is not None:
        return make_failed_outcome(recording, NOT_RUN, other)
    if _OF_STORE not in job.results:
        return _run(recording, job, Path(job.results))
    with tempfile.TemporaryDirectory(prefix="splatnode-") as folder:
        found = _run(recording, job, Path(folder))
        _upload(Path(folder), recording, job.results)
        return found


def _run(recording: BatchRecording, job: Job, out: Path) -> Outcome:
    out.mkdir(parents=True, exist_ok=True)
    made_as = f"{recording.name}.{uuid.uuid4().hex[:12]}"
    try:
        with free_core() as core:
            child = Child.start(job.work(recording, partial_folder(out, made_as)), partial_log(out, made_as), (core,))
            end = wait_for_end(child, job.limits)
        return finalize_result(recording, out, made_as, end)
    finally:
        shutil.rmtree(partial_folder(out, made_as), ignore_errors=True)
        partial_log(out, made_as).unlink(missing_ok=True)


def _upload(folder: Path, recording: BatchRecording, results: str) -> None:
    """The report is the last file, so that a result that has one is whole."""
    import fsspec  # brought by torch; its own packages know the stores

    system, root = fsspec.core.url_to_fs(results)
    result = folder / recording.name
    files = sorted((path for path in result.rglob("*") if path.is_file()), key=lambda path: path == result / REPORT)
    if not files:
        system.makedirs(root, exist_ok=True)
        system.put_file(str(folder / f"{recording.name}.log"), f"{root}/{recording.name}.log")
    for path in files:
        target = f"{root}/{path.relative_to(folder).as_posix()}"
        system.makedirs(target.rpartition("/")[0], exist_ok=True)
        system.put_file(str(path), target)
