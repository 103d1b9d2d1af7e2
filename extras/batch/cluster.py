"""The recordings of a batch on a Ray cluster.

What a recording is and how it fails is as on one machine (`remote`). Workers send one row a recording; results go from
them to the shared folder or store.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from functools import partial
from typing import Any

import msgspec

from splatnode.extras.batch.batch import BatchRecording, Outcome, make_failed_outcome
from splatnode.extras.batch.remote import Job, run_recording
from splatnode.extras.jobs.child import NOT_RUN


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
