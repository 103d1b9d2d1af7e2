"""Windows in turn, each with what was found in its scene by those that have ended before it is begun."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatnode.recon.evaluate.stability.places import TrialScene
from splatnode.recon.evaluate.stability.windows.row import Key as RowKey
from splatnode.recon.evaluate.stability.windows.row import make_key
from splatnode.recon.evaluate.stability.windows.store import Key, Pieces, select_keys
from splatnode.recon.evaluate.stability.windows.window import Window


@dataclass(frozen=True, eq=False)
class Job:
    place: TrialScene
    window: Window
    method: str

    @property
    def key(self) -> RowKey:
        return make_key(self.window, self.method)


class WindowScheduler:
    """Windows of one scene come one after the other, as long as there are other scenes for whoever else is free.

    What was found lies in `folder` until the last window of its scene has ended.
    """

    def __init__(self, jobs: Sequence[Job], folder: Path) -> None:
        self._waiting = list(jobs)
        self._under_way: Counter[TrialScene] = Counter()
        self._folder, self._numbers = folder, itertools.count()
        self._found: dict[TrialScene, dict[Key, Path]] = {}

    def take_job(self) -> tuple[Job, Pieces] | None:
        """The first window of a scene of which none is under way, else the first; None: all have begun."""
        if not self._waiting:
            return None
        idle = (job for job in self._waiting if not self._under_way[job.place])
        job = next(idle, self._waiting[0])
        self._waiting.remove(job)
        self._under_way[job.place] += 1
        found = self._found.get(job.place, {})
        return job, {key: found[key].read_bytes() for key in select_keys(found.keys(), job.window.names)}

    def finish_job(self, job: Job, found: Mapping[Key, bytes]) -> None:
        """Stores what a window has found; nothing where it failed."""
        self._under_way[job.place] -= 1
        known = self._found.setdefault(job.place, {})
        if not self._under_way[job.place] and not any(other.place is job.place for other in self._waiting):
            for path in self._found.pop(job.place).values():
                path.unlink()
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        for key in found.keys() - known.keys():
            known[key] = self._folder / str(next(self._numbers))
            known[key].write_bytes(found[key])
