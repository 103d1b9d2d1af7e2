"""What a row of the matrix gives for one seed: photographs, what is true about them, and what is asked."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from msgspec.structs import replace

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.config import PREVIEW, Config
from splatnode.recon.evaluate.stability.places import Photo, Sampler
from splatnode.recon.evaluate.truth import TrueCamera
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import Code

Source = Callable[[], Iterable[Frame | DroppedFrame]]
World = Mapping[str, TrueCamera]  # by the name of the frame

# The verdict stands before the first step of the optimiser, so that few steps at a small size ask the same question.
# They leave the cameras as they were judged: a handful of steps would move them without improving them.
_STILL = replace(PREVIEW, checkpoints=(), refine_poses=False)
LIGHT = Config(size=320, preview=replace(_STILL, iterations=2), optimize=replace(_STILL, iterations=6))


_WHOLE = (Code.OK, Code.EXPOSURE_SHIFT)  # a scene of all frames: recorded photographs differ in exposure too


class Demand(enum.Enum):
    ACCEPT = "accept"  # a refusal is a false refusal
    REFUSE = "refuse"
    EITHER = "either"  # nobody could tell in advance: a refusal is as good as a right answer


@dataclass(frozen=True)
class Measured:
    """What a row measures besides the verdict; `held` tells whether it is within the row's limits."""

    values: Mapping[str, float]
    held: bool


Probe = Callable[[Snapshot, Config], Measured]


@dataclass(frozen=True, eq=False)
class Case:
    """`source`, `config` and `probe` are sent to another process, so they hold nothing but data and module functions.

    `worlds` are the true cameras of frames that belong together: a published scene is right if all its cameras are of
    one world and agree with it. Frames in no world may be in no scene.
    """

    note: str  # made by `described`
    source: Source
    demand: Demand
    codes: frozenset[Code]  # verdicts that describe these frames
    worlds: tuple[World, ...] = ()
    config: Config = LIGHT
    probe: Probe | None = None  # runs where splatnode has published a scene
    stream: bool = False  # the frames come one at a time


@dataclass(frozen=True)
class Row:
    """`number` is that of the matrix in the project's notes; several rows may share one."""

    number: int
    name: str
    make: Callable[[Sampler], Case]


def row(number: int, name: str) -> Callable[[Callable[[Sampler], Case]], Row]:
    """Makes the decorated function a row of the matrix."""
    return partial(Row, number, name)


def frames(photos: Sequence[Photo]) -> tuple[Frame, ...]:
    """What a reconstruction gets. Raises ValueError where two photographs have one name."""
    names = [photo.name for photo in photos]
    if len(set(names)) < len(names):
        raise ValueError(f"photographs must have different names, got {', '.join(names)}")
    return tuple(Frame(i, photo.name, i, photo.image, photo.intrinsics) for i, photo in enumerate(photos))


def all_at_hand(photos: Sequence[Photo]) -> Source:
    return partial(list, frames(photos))


def one_by_one(photos: Sequence[Photo]) -> Source:
    return partial(iter, frames(photos))


def world(photos: Sequence[Photo]) -> World:
    """The true cameras of `photos` as one world."""
    return {photo.name: photo.camera for photo in photos if photo.camera is not None}


def described(photos: Sequence[Photo], note: str) -> str:
    """The note of a case: the places, the number of frames, and what was done to them."""
    places = " and ".join(dict.fromkeys(photo.place for photo in photos if photo.place)) or "made up"
    return f"{places}, {len(photos)} frames" + (f": {note}" if note else "")


def accepted(photos: Sequence[Photo], note: str, *codes: Code, probe: Probe | None = None) -> Case:
    """Photographs that are enough for a scene. Besides `codes`, OK is always fitting, and so is a change of light."""
    fitting = frozenset((*_WHOLE, *codes))
    return Case(described(photos, note), all_at_hand(photos), Demand.ACCEPT, fitting, (world(photos),), probe=probe)


def refused(photos: Sequence[Photo], note: str, *codes: Code) -> Case:
    """Photographs that are not enough: a refusal is right, and a scene that is published is compared with the truth."""
    return Case(described(photos, note), all_at_hand(photos), Demand.REFUSE, frozenset(codes), (world(photos),))


def either(photos: Sequence[Photo], note: str, *codes: Code) -> Case:
    """Photographs that may or may not be enough."""
    fitting = frozenset((*_WHOLE, Code.OK_PARTIAL, *codes))
    return Case(described(photos, note), all_at_hand(photos), Demand.EITHER, fitting, (world(photos),))
