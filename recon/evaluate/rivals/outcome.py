"""The snapshots and verdicts of a rival. It publishes whatever it finds: its only refusal is to find nothing."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from splatnode.capture.frame import Frame
from splatnode.recon.clock import Clock
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.scene.scene import Scene

MIN_CAMERAS = 3  # a model of two cameras counts as no answer, for every method


def make_verdict(frames: Sequence[Frame], registered: Collection[str]) -> Verdict:
    """Returns the verdict where cameras of the frames named `registered` were found."""
    missing = tuple(frame.name for frame in frames if frame.name not in registered)
    sentence = f"{len(registered)} of {len(frames)} photographs were placed."
    if len(registered) < MIN_CAMERAS:
        return Verdict(Code.NO_OVERLAP, sentence, "", missing)
    return Verdict(Code.OK_PARTIAL if missing else Code.OK, sentence, "", missing, publishable=True)


def make_refusal(frames: Sequence[Frame], clock: Clock) -> Snapshot:
    """No scene, because too few cameras were found."""
    return Snapshot(
        sequence=1,
        verdict=make_verdict(frames, ()),
        cameras=(),
        gaussians=GaussianArrays.empty(),
        images={},
        dropped=(),
        iterations=0,
        seconds=clock.stage_seconds,
        final=True,
    )


def make_snapshot(frames: Sequence[Frame], scene: Scene) -> Snapshot:
    """Makes the snapshot of Gaussians and the cameras that they were fitted with."""
    return Snapshot(
        sequence=0,
        verdict=make_verdict(frames, {view.name for view in scene.views}),
        cameras=scene.cameras(),
        gaussians=scene.arrays(),
        images={},
        dropped=(),
        iterations=scene.iterations,
        served_by=scene.served_by,
    )


def number_snapshots(
    snapshots: Iterable[Snapshot], clock: Clock, served_by: Mapping[str, str] = MappingProxyType({})
) -> Iterator[Snapshot]:
    """The snapshots that an optimisation gives, numbered and timed as "optimise", and the last one again as final.

    `served_by` names what took the place of networks that the publication has.
    """
    last = None
    for sequence, snapshot in enumerate(snapshots, 1):
        clock.lap("optimise")
        last = replace(
            snapshot, sequence=sequence, seconds=clock.stage_seconds, served_by={**snapshot.served_by, **served_by}
        )
        yield last
        clock.lap("wait")
    assert last is not None  # an optimisation gives its end
    yield replace(last, sequence=last.sequence + 1, final=True)
