"""All that is known of a station's cameras over its recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from splatnode.capture.frame import Intrinsics
from splatnode.capture.process.progress import ProgressStep, Tell, ignore_progress
from splatnode.recon.auditing.history import Move, Period, extend_history, find_moves
from splatnode.recon.auditing.sighting import CameraSighting, SightingFailure, localize_camera
from splatnode.recon.auditing.stations import StationRecording
from splatnode.recon.auditing.taken import load_sample_frames
from splatnode.recon.result.landmarks import Landmarks


@dataclass(frozen=True, eq=False)
class Audit:
    """The result of `audit`. Recordings are identified by their number in `recordings`."""

    recordings: tuple[str, ...]  # their names, in the order given, which is that of time
    periods: Mapping[str, Sequence[Period]]  # of each camera that was placed at least once, by its name
    not_seen: Mapping[str, Mapping[int, SightingFailure]]  # of each camera, where it was not placed
    unreadable: Mapping[int, str]  # recordings of whose cameras nothing is known, and why
    moves: Sequence[Move]  # in their order
    unit: float  # the distance to the scene: the median depth of its points, in the unit of the result
    metric: bool  # lengths are metres

    @property
    def comparable_cameras(self) -> list[str]:
        """The cameras that were placed in two recordings or more."""
        return [name for name, history in self.periods.items() if sum(len(each.recordings) for each in history) > 1]


def audit(
    landmarks: Landmarks,
    recordings: Sequence[StationRecording],
    given: Intrinsics | None = None,
    fov_deg: float | None = None,
    tell: Tell = ignore_progress,
) -> Audit:
    """Localizes each camera in each recording, in the world of the landmarks, and finds when it moved.

    `given` is the cameras' lens; `fov_deg` their angle of view across the longer side, in degrees. What is in memory
    grows with the moves, not with the recordings.
    """
    histories: dict[str, list[Period]] = {}
    not_seen: dict[str, dict[int, SightingFailure]] = {}
    total, done = sum(len(recording.cameras) for recording in recordings), 0
    for number, recording in enumerate(recordings):
        for camera, pictures in recording.cameras.items():
            tell(ProgressStep("placing", done, total, "camera"))
            found = localize_camera(landmarks, load_sample_frames(pictures, given), fov_deg)
            if isinstance(found, CameraSighting):
                histories[camera] = extend_history(histories.get(camera, ()), number, found)
            else:
                not_seen.setdefault(camera, {})[number] = found
            done += 1
    histories = {camera: histories[camera] for camera in sorted(histories)}
    names = tuple(recording.name for recording in recordings)
    unreadable = {number: each.problem for number, each in enumerate(recordings) if each.problem}
    return Audit(names, histories, not_seen, unreadable, find_moves(histories), landmarks.unit, landmarks.metric)
