"""What a rival tells. It publishes whatever it finds: its only refusal is to find nothing."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence

from capture.frame import Frame
from recon.clock import Clock
from recon.scene import Scene
from recon.snapshot import CameraEstimate, GaussianArrays, Snapshot
from recon.verdict import Code, Verdict

MIN_CAMERAS = 3  # a model of two cameras counts as no answer, for every method


def verdict(frames: Sequence[Frame], placed: Collection[str]) -> Verdict:
    """What to say when cameras of the frames named `placed` were found."""
    missing = tuple(frame.name for frame in frames if frame.name not in placed)
    told = f"{len(placed)} of {len(frames)} frames were placed."
    if len(placed) < MIN_CAMERAS:
        return Verdict(Code.NO_OVERLAP, told, "", missing)
    return Verdict(Code.OK_PARTIAL if missing else Code.OK, told, "", missing, publishable=True)


def refused(frames: Sequence[Frame], clock: Clock) -> Snapshot:
    """No scene, because too few cameras were found."""
    return _snapshot(verdict(frames, ()), (), GaussianArrays.empty(), 0, clock, sequence=1, final=True)


def told(frames: Sequence[Frame], scenes: Iterable[Scene], clock: Clock) -> Iterator[Snapshot]:
    """A snapshot of every scene that an optimisation gives, and a final one of the last. Its time is "optimise"."""
    sequence, scene = 0, None
    for sequence, scene in enumerate(scenes, 1):
        clock.lap("optimise")
        yield _of_scene(frames, scene, clock, sequence, final=False)
        clock.lap("wait")
    assert scene is not None  # an optimisation gives its end
    yield _of_scene(frames, scene, clock, sequence + 1, final=True)


def _of_scene(frames: Sequence[Frame], scene: Scene, clock: Clock, sequence: int, *, final: bool) -> Snapshot:
    said = verdict(frames, {view.name for view in scene.views})
    return _snapshot(said, scene.cameras(), scene.arrays(), scene.iterations, clock, sequence=sequence, final=final)


def _snapshot(
    said: Verdict,
    cameras: tuple[CameraEstimate, ...],
    gaussians: GaussianArrays,
    iterations: int,
    clock: Clock,
    *,
    sequence: int,
    final: bool,
) -> Snapshot:
    return Snapshot(
        sequence=sequence,
        verdict=said,
        cameras=cameras,
        gaussians=gaussians,
        images={},
        dropped=(),
        iterations=iterations,
        seconds=clock.booked,
        final=final,
    )
