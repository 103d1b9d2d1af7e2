"""The recordings of a batch on a Ray cluster.

What a recording is and how it fails is as on one machine (`remote`). Workers send one row a recording; results go from
them to the shared folder or store.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from functools import partial
from typing import Any

import msgspec

from splatnode.recon.batch.answer import Outcome, without_answer
from splatnode.recon.batch.remote import Job, run_recording
from splatnode.recon.batch.sources import Recording
from splatnode.recon.jobs.child import NOT_RUN


def run_all(todo: Iterable[Recording], job: Job, most: int | None) -> Generator[Outcome, None, None]:
    """The outcomes as they come, of at most `most` recordings at a time; None: of as many as the cluster has cores.

    A recording whose worker is lost is repeated elsewhere; after a few times it has failed. Raises ModuleNotFoundError
    without ray, which must have been joined.
    """
    from splatnode.recon.jobs import ray  # takes a second, and is an extra

    run = partial(run_recording, job=job)
    for recording, found in ray.mapped(partial(next, iter(todo), None), run, most, job.limits.memory_mb):
        yield without_answer(recording, NOT_RUN, found.reason) if isinstance(found, ray.Lost) else found


def run_row(row: dict[str, Any], job: Job) -> dict[str, Any]:
    """A row of a dataset, which has name and source, with what came of it, column by column."""
    return {**row, **msgspec.structs.asdict(run_recording(Recording(row["name"], row["source"]), job))}
