"""Many recordings in a Ray pipeline of your own: `import splatnode.batch`. Needs the extra ray.

A recording is one row: `name` and `source`. Your rows may have more columns, and more steps before and after.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

Dataset: TypeAlias = Any  # ray.data.Dataset: ray is an extra

__all__ = ["reconstruct_dataset", "recordings"]


def recordings(
    sources: Sequence[str | PathLike[str]], results: str | PathLike[str] | None = None
) -> list[dict[str, str]]:
    """The rows of all recordings that these sources hold, as `splatnode batch` finds them: name and source.

    Sources are folders of photographs, videos, MCAP files, LeRobot data sets, folders that hold such, and lists (.txt).
    What lies in the folder `results`, if one is given, is none. Raises FileNotFoundError, ValueError.
    """
    from splatnode.extras.batch import recordings as found

    there = found([Path(source) for source in sources], None if results is None else Path(results))
    return [{"name": each.name, "source": each.source} for each in there]


def reconstruct_dataset(
    ds: Dataset,
    results: str | PathLike[str],
    *,
    options: Sequence[str] = (),
    max_memory_mb: float | None = None,
    timeout_s: float | None = None,
) -> Dataset:
    """The rows of `ds`, each with what came of its recording: the columns of `batch.csv`, such as verdict and message.

    - `ds`: a Ray dataset whose rows have `name`, different in each, and `source`, a path that all workers know.
    - `results`: where the workers write the result folders: a folder that they share, or an object store's address.
      A result is whole or not there; a row that is run again, after a worker was lost, gives the same, to the bit.
    - `options`: of `splatnode replay`, such as `("--preset", "fast", "--views", "12")`.
    - `max_memory_mb`, `timeout_s`: a recording that takes more, in 10^6 bytes and seconds, fails alone.

    Each row takes one core. Like all of Ray Data this is lazy: the work begins when the rows are read. What fails is a
    row with the verdict FAILED. Raises ModuleNotFoundError without ray.
    """
    from splatnode.extras import batch
    from splatnode.extras.batch import Job
    from splatnode.extras.batch.command import replay
    from splatnode.extras.jobs import Limits, own_version

    where = str(results) if "://" in str(results) else str(Path(results).resolve())
    job = Job(partial(replay, tuple(options)), where, Limits(max_memory_mb, timeout_s), own_version())
    return ds.map(partial(batch.run_row, job=job), num_cpus=1)
