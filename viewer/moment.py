"""Moments: snapshots as they reached the viewer, and the bounded history of them that the time slider goes through."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.result.snapshot import Snapshot
from splatnode.viewer.graph import Graph

MEMORY_BYTES = 256_000_000  # of a history: some fifty moments of 30 000 Gaussians and 12 cameras
_SMALLEST = 16  # pixels: a photograph that is drawn smaller is a spot


@dataclass(frozen=True, eq=False)
class Moment:
    """A snapshot as it reached the viewer. Its `images` may be of any size, and may lack some cameras."""

    snapshot: Snapshot
    received_s: float  # monotonic clock of the viewer
    scene_id: str = ""  # another one is another place: a viewpoint does not carry over
    graph: Graph | None = None  # of a map of several scenes, of which this is what is loaded; None: of one scene

    @cached_property
    def photographs(self) -> dict[str, tuple[npt.NDArray[np.uint8], ...]]:
        """The images at their size, at half of it, at a quarter and so on: what is drawn small must not flicker."""
        return {name: _build_image_pyramid(image) for name, image in self.snapshot.images.items()}

    @property
    def num_bytes(self) -> int:
        gaussians = self.snapshot.gaussians
        arrays = sum(getattr(gaussians, field.name).nbytes for field in fields(gaussians))
        return arrays + sum(4 * image.nbytes // 3 for image in self.snapshot.images.values())  # with `photographs`


History = tuple[Moment, ...]  # oldest first

_MOST_MOVED = 0.5  # of the spread of the cameras, by which those of a scene that grows may move from moment to moment


def same_world(one: Moment, other: Moment) -> bool:
    """Whether a point of one is at the same place in the other: in one scene and unit, with cameras where they were.

    A scene comes into another world when metres, or poses that were given, become known.
    """
    if one.scene_id != other.scene_id or one.snapshot.scale.metric != other.snapshot.scale.metric:
        return False
    if one.graph is not None:
        return True  # a map stays where it is
    known = {camera.name: camera.T_world_camera[:3, 3] for camera in other.snapshot.cameras}
    both = [
        (camera.T_world_camera[:3, 3], known[camera.name]) for camera in one.snapshot.cameras if camera.name in known
    ]
    if len(both) < 2:
        return True
    here, there = np.array(both).swapaxes(0, 1)
    spread = max(float(np.linalg.norm(each.std(axis=0))) for each in (here, there))  # RMS distance from their mean
    return bool(np.linalg.norm(here - there, axis=1).max() <= _MOST_MOVED * spread)


def append_moment(history: History, moment: Moment, memory_bytes: int = MEMORY_BYTES) -> History:
    """The history with `moment` as its newest, thinned until it fits into `memory_bytes`.

    What goes first is the moment whose neighbours are closest together in time, so that the whole time axis stays
    covered. The first and the newest moment always stay. Of a map only the newest does: the others had parts of it.
    """
    if moment.graph is not None:
        return (moment,)
    kept = [*history, moment]
    while len(kept) > 2 and sum(one.num_bytes for one in kept) > memory_bytes:
        gaps = [after.received_s - before.received_s for before, after in zip(kept, kept[2:], strict=False)]
        del kept[1 + int(np.argmin(gaps))]
    return tuple(kept)


def _build_image_pyramid(image: npt.NDArray[np.uint8]) -> tuple[npt.NDArray[np.uint8], ...]:
    levels = [image]
    while min(levels[-1].shape[:2]) >= 2 * _SMALLEST:
        height, width = levels[-1].shape[:2]
        levels.append(
            np.asarray(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8)
        )
    return tuple(levels)
