"""The recordings of a batch on a Ray cluster: each is a function of values on a worker.

Its result is whole in a shared folder or a store. It may run more than once for one recording, after a worker or a
machine is lost, and even twice at a time: each run makes its result under a name of its own, and the last one counts,
which is the same to the bit. What a recording is and how it fails is as on one machine. Workers send one row a
recording."""

from __future__ import annotations

import shutil
import tempfile
import uuid
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

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
from splatnode.extras.jobs.calls import free_core, other_version
from splatnode.extras.jobs.child import NOT_RUN, Child, Limits, wait_for_end

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


def run_all(todo: Iterable[BatchRecording], job: Job, most: int | None) -> Generator[Outcome, None, None]:
    """The outcomes as they come, of at most `most` recordings at a time; None: of as many as the cluster has cores.

    A recording whose worker is lost is repeated elsewhere; after a few times it has failed. Raises ModuleNotFoundError
    without ray, which must have been joined.
    """
    from splatnode.extras.jobs import ray  # takes a second, and is an extra

    run = partial(run_recording, job=job)
    for recording, found in ray.map_on_cluster(partial(next, iter(todo), None), run, most, job.limits.memory_mb):
        yield make_failed_outcome(recording, NOT_RUN, found.reason) if isinstance(found, ray.LostCall) else found


def shortage(max_memory_mb: float | None) -> str | None:
    """Returns a message if no machine of the cluster has so much memory for a recording; None if one has.

    Ray, which must have been joined, would wait for such a machine without a word.
    """
    from splatnode.extras.jobs.ray import ray

    resources = (node["Resources"] for node in ray.nodes() if node["Alive"])
    most_mb = max((each.get("memory", 0.0) / 1e6 for each in resources if each.get("CPU")), default=0.0)
    if max_memory_mb is None or not most_mb or max_memory_mb <= most_mb:
        return None
    return (
        f"no machine of the cluster has the {max_memory_mb:g} MB that --max-memory sets aside for each recording, the "
        f"largest has {most_mb:.0f} MB: give less"
    )


def run_row(row: dict[str, Any], job: Job) -> dict[str, Any]:
    """A row of a dataset, which has name and source, with what came of it, column by column."""
    return {**row, **msgspec.structs.asdict(run_recording(BatchRecording(row["name"], row["source"]), job))}
