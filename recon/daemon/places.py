"""places.json: all places that the node has seen, what became of each, and of each photograph that was taken there."""

from __future__ import annotations

import enum
import logging
from collections.abc import Collection, Sequence
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame
from splatnode.capture.process.foreign import foreign
from splatnode.recon.daemon.links import MIN_SHARED, Link, link
from splatnode.recon.result.export import SceneFileError, read_cameras, write_file
from splatnode.recon.result.export.limits import read_json_file
from splatnode.recon.result.export.staged import json_bytes
from splatnode.recon.result.snapshot import Snapshot

log = logging.getLogger(__name__)

FILE = "places.json"


class State(enum.Enum):
    HERE = "here"  # the camera is there: the scene may grow
    LEFT = "left"  # the camera went on: the scene is finished when no keyframe waits
    FINISHED = "finished"  # the scene is final


class Dropped(msgspec.Struct, frozen=True):
    name: str
    reason: str


class Place(msgspec.Struct, frozen=True):
    """A place, as it was when it was last looked at."""

    scene_id: str
    state: State
    folder: str | None  # with its result, in that of places.json; None: there is none
    verdict: str
    message: str
    publishable: bool
    provisional: bool
    num_gaussians: int
    frames_used: tuple[str, ...]  # that have a camera in the scene
    frames_dropped: tuple[Dropped, ...]  # all others that were taken there, and why they have none


def described(
    scene_id: str,
    state: State,
    folder: str | None,
    snapshot: Snapshot,
    kept: Sequence[str],
    dropped: Collection[DroppedFrame],
) -> Place:
    """The place as the snapshot shows it. `kept` are the names of its keyframes; others that came were `dropped`."""
    verdict = snapshot.verdict
    used = tuple(camera.name for camera in snapshot.cameras)
    why = "it has no camera in the scene" if used else f"there is no scene: {verdict.code.value}"
    unplaced = (Dropped(name, why) for name in kept if name not in used)
    return Place(
        scene_id=scene_id,
        state=state,
        folder=folder,
        verdict=verdict.code.value,
        message=verdict.message,
        publishable=verdict.publishable,
        provisional=verdict.provisional or not snapshot.final,
        num_gaussians=len(snapshot.gaussians),
        frames_used=used,
        frames_dropped=(*unplaced, *(Dropped(frame.name, frame.reason) for frame in dropped)),
    )


class _Index(msgspec.Struct, frozen=True):
    checkpoint: str  # identity of the one that the places belong to
    places: tuple[Place, ...] = ()
    links: tuple[Link, ...] = ()  # between final scenes that share photographs


class Places:
    """The file, and what is in it."""

    def __init__(self, out: Path, checkpoint: str) -> None:
        """Goes on with the places of an earlier process that had the same `checkpoint`.

        An index that cannot be read begins anew.
        """
        self._path, self._index = out / FILE, _Index(checkpoint)
        try:
            with foreign(SceneFileError):
                found = msgspec.json.decode(read_json_file(self._path), type=_Index)
            if found.checkpoint == checkpoint:
                self._index = found
        except FileNotFoundError:
            pass
        except (OSError, SceneFileError) as error:
            log.warning("the index of places begins anew: %s", error)

    def scene_of(self, name: str) -> str | None:
        """The id of the first scene that has a camera of this photograph; None: no scene has."""
        return next((place.scene_id for place in self._index.places if name in place.frames_used), None)

    def finished(self, scene_id: str) -> None:
        """Says that the camera has left a place whose scene is final. Raises ResultWriteError."""
        for place in (place for place in self._index.places if place.scene_id == scene_id):
            self.tell(msgspec.structs.replace(place, state=State.FINISHED))

    def tell(self, place: Place) -> None:
        """Writes the index with what is known of this place now. Raises ResultWriteError."""
        places = {each.scene_id: each for each in self._index.places} | {place.scene_id: place}
        self._write(msgspec.structs.replace(self._index, places=tuple(places.values())))

    def link(self, scene_id: str) -> None:
        """Writes how this final scene lies to the other final ones that share photographs with it.

        Raises ResultWriteError.
        """
        final = {place.scene_id: place for place in self._index.places if not place.provisional and place.publishable}
        links = [each for each in self._index.links if scene_id not in (each.scene, each.other)]
        mine = final.pop(scene_id, None)
        if mine is not None:
            used = set(mine.frames_used)
            near = [place for place in final.values() if len(used.intersection(place.frames_used)) >= MIN_SHARED]
            pairs = [sorted((mine, other), key=lambda place: place.scene_id) for other in near]
            found = (link(a.scene_id, b.scene_id, self._cameras(a), self._cameras(b)) for a, b in pairs)
            links += [each for each in found if each is not None]
        self._write(msgspec.structs.replace(self._index, links=tuple(links)))

    def _cameras(self, place: Place) -> dict[str, npt.NDArray[np.float64]]:
        """T_world_camera by the names of the photographs, as they were exported; none that cannot be read."""
        try:
            cameras = read_cameras(self._path.parent / (place.folder or "") / "cameras.json")
        except (OSError, SceneFileError) as error:
            log.warning("the cameras of %s cannot be read: %s", place.scene_id, error)
            return {}
        return {camera.name: camera.T_world_camera for camera in cameras}

    def _write(self, index: _Index) -> None:
        if index != self._index:
            write_file(self._path, json_bytes(msgspec.to_builtins(index)))
            self._index = index
