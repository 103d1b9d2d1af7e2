"""Photographs that are all at hand, from what is asked for to what is written.

`splatnode replay` and the Python interface call this.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.process.progress import Tell, ignore_progress
from splatnode.recon import threads
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.metric.evidence import NOTHING, Evidence, gather_evidence
from splatnode.recon.metric.metres import apply_metric_scale
from splatnode.recon.pipeline import reconstruct
from splatnode.recon.replay_source import IMAGES, Source
from splatnode.recon.result.only_seen import remove_unconfirmed
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.write import write_result_folder


@dataclass(frozen=True, eq=False)
class OfflineResult:
    """The result of an offline reconstruction, with what its report says of how it was made."""

    snapshot: Snapshot
    source: Source  # without its frames where a folder has them
    seed: int
    preset: str

    def write(self, out: Path) -> dict[str, object]:
        """Writes the result folder and returns its report.

        Raises ResultWriteError, with what was there before intact.
        """
        files = self.source.files() if self.snapshot.verdict.publishable else {}
        lie_in = self.source.photographs or (out / IMAGES if files else None)
        told: dict[str, object] = {"photographs": None if lie_in is None else _encode_path(lie_in.resolve())}
        if self.source.choice is not None:
            told["selection"] = self.source.choice.record()
        return write_result_folder(
            self.snapshot, out, seed=self.seed, preset_name=self.preset, photographs=files, told=told
        )


def _encode_path(folder: Path) -> str | None:
    """The folder's path; None where it is no text, as Linux allows, which no JSON file can hold."""
    try:
        return folder.as_posix().encode().decode()
    except UnicodeEncodeError:
        return None


def ignore_snapshot(_: Snapshot) -> None:
    """Ignores a snapshot: nobody watches."""


def reconstruct_source(
    source: Source,
    config: ReconstructionConfig,
    preset_name: str,
    without_guesses: bool = False,
    most_threads: int | None = None,
    given: Evidence = NOTHING,
    *,
    show: Callable[[Snapshot], None] = ignore_snapshot,
    tell: Tell = ignore_progress,
) -> OfflineResult:
    """The final snapshot of what `source` gives, in metres where `config` knows how.

    `given` is what is known of metres beside the photographs. `without_guesses` leaves out what no two photographs
    confirm. `show` gets every snapshot, and `tell` hears what is being done. The work takes `most_threads` threads at
    most; None: as many as the process may use.
    Raises ValueError where the intrinsics of a photograph or a number of threads cannot be used.
    """
    with threads.apply_thread_limit(most_threads):
        evidence = given.merge(gather_evidence(source.frames, config.metric, tell))
        snapshot = apply_metric_scale(run(source.frames, config, show, tell), config.metric, evidence)
    if without_guesses:
        snapshot = remove_unconfirmed(snapshot)
    kept = source if source.photographs is None else replace(source, frames=())
    return OfflineResult(snapshot, kept, config.seed, preset_name)


def run(
    frames: Iterable[Frame | DroppedFrame],
    config: ReconstructionConfig,
    show: Callable[[Snapshot], None] = ignore_snapshot,
    tell: Tell = ignore_progress,
) -> Snapshot:
    """The final snapshot; every one is given to `show`, and what is being done to `tell`."""
    snapshot = None
    for snapshot in reconstruct(frames, config, tell):
        show(snapshot)
    if snapshot is None:
        raise AssertionError("reconstruct always yields a last snapshot")
    return snapshot


def check_baseline(config: ReconstructionConfig, source: Source) -> None:
    """Raises ValueError before the work where a measured distance names a photograph that is not used."""
    names = [frame.name for frame in source.frames]
    missing = [name for baseline in config.metric.baselines for name in baseline[:2] if name not in names]
    if missing and source.choice is not None:
        raise ValueError(
            f"the baseline's photograph {missing[0]!r} is not among those that were chosen: {', '.join(names)}. "
            f"Measure between two of these, or use all {source.choice.what}s (--every-frame)"
        )
    if missing:
        raise ValueError(
            f"the baseline's photograph {missing[0]!r} is not among those that are used: {', '.join(names)}. "
            "Measure between two of these, or have it used, too"
        )


def set_preview_interval(config: ReconstructionConfig, every: int) -> ReconstructionConfig:
    """The same reconstruction, with a snapshot to look at `every` so many iterations."""
    looks = tuple(range(every, config.optimize.iterations, every))
    return msgspec.structs.replace(config, optimize=msgspec.structs.replace(config.optimize, looks=looks))
