"""What a row of the matrix gives for one seed: photographs, what is true about them, and what is asked."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from msgspec.structs import replace

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.config import PREVIEW, ReconstructionConfig
from splatnode.recon.evaluate.stability.places import Sampler, TrialImage
from splatnode.recon.evaluate.truth import TrueCamera
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import Code

Source = Callable[[], Iterable[Frame | DroppedFrame]]
World = Mapping[str, TrueCamera]  # by the name of the frame

# The verdict stands before the first step of the optimiser, so that few steps at a small size ask the same question.
# They leave the cameras as they were judged: a handful of steps would move them without improving them.
_STILL = replace(PREVIEW, checkpoints=(), refine_poses=False)
LIGHT = ReconstructionConfig(size=320, preview=replace(_STILL, iterations=2), optimize=replace(_STILL, iterations=6))


_WHOLE = (Code.OK, Code.EXPOSURE_SHIFT)  # a scene of all frames: recorded photographs differ in exposure too


class Demand(enum.Enum):
    ACCEPT = "accept"  # a refusal is a false refusal
    REFUSE = "refuse"
    EITHER = "either"  # nobody could tell in advance: a refusal is as good as a right answer


@dataclass(frozen=True)
class ProbeResult:
    """The measurements of a row besides the verdict; `held` tells whether they are within its limits."""

    values: Mapping[str, float]
    held: bool


Probe = Callable[[Snapshot, ReconstructionConfig], ProbeResult]


@dataclass(frozen=True, eq=False)
class TrialCase:
    """`source`, `config` and `probe` are sent to another process, so they hold nothing but data and module functions.

    `worlds` are the true cameras of frames that belong together: a published scene is right if all its cameras are of
    one world and agree with it. Frames in no world may be in no scene.
    """

    note: str  # made by `describe_case`
    source: Source
    demand: Demand
    codes: frozenset[Code]  # verdicts that describe these frames
    worlds: tuple[World, ...] = ()
    config: ReconstructionConfig = LIGHT
    probe: Probe | None = None  # runs where splatnode has published a scene
    stream: bool = False  # the frames come one at a time


@dataclass(frozen=True)
class MatrixRow:
    """`number` is that of the matrix in the project's notes; several rows may share one."""

    number: int
    name: str
    make: Callable[[Sampler], TrialCase]


def row(number: int, name: str) -> Callable[[Callable[[Sampler], TrialCase]], MatrixRow]:
    """Makes the decorated function a row of the matrix."""
    return partial(MatrixRow, number, name)


def make_frames(photos: Sequence[TrialImage]) -> tuple[Frame, ...]:
    """Makes what a reconstruction gets. Raises ValueError where two images have one name."""
    names = [photo.name for photo in photos]
    if len(set(names)) < len(names):
        raise ValueError(f"photographs must have different names, got {', '.join(names)}")
    return tuple(Frame(i, photo.name, i, photo.image, photo.intrinsics) for i, photo in enumerate(photos))


def make_batch_source(photos: Sequence[TrialImage]) -> Source:
    return partial(list, make_frames(photos))


def make_stream_source(photos: Sequence[TrialImage]) -> Source:
    return partial(iter, make_frames(photos))


def make_world(photos: Sequence[TrialImage]) -> World:
    """The true cameras of `photos` as one world."""
    return {photo.name: photo.camera for photo in photos if photo.camera is not None}


def describe_case(photos: Sequence[TrialImage], note: str) -> str:
    """The note of a case: the places, the number of frames, and what was done to them."""
    places = " and ".join(dict.fromkeys(photo.place for photo in photos if photo.place)) or "made up"
    return f"{places}, {len(photos)} frames" + (f": {note}" if note else "")


def make_accept_case(photos: Sequence[TrialImage], note: str, *codes: Code, probe: Probe | None = None) -> TrialCase:
    """Photographs that are enough for a scene. Besides `codes`, OK is always fitting, and so is a change of light."""
    fitting = frozenset((*_WHOLE, *codes))
    return TrialCase(
        describe_case(photos, note),
        make_batch_source(photos),
        Demand.ACCEPT,
        fitting,
        (make_world(photos),),
        probe=probe,
    )


def make_refuse_case(photos: Sequence[TrialImage], note: str, *codes: Code) -> TrialCase:
    """Photographs that are not enough: a refusal is right, and a scene that is published is compared with the truth."""
    return TrialCase(
        describe_case(photos, note), make_batch_source(photos), Demand.REFUSE, frozenset(codes), (make_world(photos),)
    )


def make_either_case(photos: Sequence[TrialImage], note: str, *codes: Code) -> TrialCase:
    """Photographs that may or may not be enough."""
    fitting = frozenset((*_WHOLE, Code.OK_PARTIAL, *codes))
    return TrialCase(
        describe_case(photos, note), make_batch_source(photos), Demand.EITHER, fitting, (make_world(photos),)
    )
