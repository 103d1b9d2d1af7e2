"""All that is known of a station's cameras over its recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from splatnode.capture.frame import Intrinsics
from splatnode.capture.process.progress import Step, Tell, told_to_nobody
from splatnode.recon.auditing.history import Move, Period, extended, moves
from splatnode.recon.auditing.sighting import NotSeen, Sighting, sight
from splatnode.recon.auditing.stations import Recording
from splatnode.recon.auditing.taken import taken
from splatnode.recon.result.landmarks import Landmarks


@dataclass(frozen=True, eq=False)
class Audit:
    """What `audit` finds. Recordings are called by their number in `recordings`."""

    recordings: tuple[str, ...]  # their names, in the order given, which is that of time
    periods: Mapping[str, Sequence[Period]]  # of each camera that was placed at least once, by its name
    not_seen: Mapping[str, Mapping[int, NotSeen]]  # of each camera, where it was not placed
    unreadable: Mapping[int, str]  # recordings of whose cameras nothing is known, and why
    moves: Sequence[Move]  # in their order
    unit: float  # the distance to the scene: the median depth of its points, in the unit of the result
    metric: bool  # lengths are metres

    @property
    def compared(self) -> list[str]:
        """The cameras that were placed in two recordings or more."""
        return [name for name, history in self.periods.items() if sum(len(each.recordings) for each in history) > 1]


def audit(
    landmarks: Landmarks,
    recordings: Sequence[Recording],
    given: Intrinsics | None = None,
    fov_deg: float | None = None,
    tell: Tell = told_to_nobody,
) -> Audit:
    """Where each camera stood in each recording, in the world of the landmarks, and when it moved.

    `given` is the cameras' lens; `fov_deg` their angle of view across the longer side, in degrees. What is in memory
    grows with the moves, not with the recordings.
    """
    histories: dict[str, list[Period]] = {}
    not_seen: dict[str, dict[int, NotSeen]] = {}
    total, done = sum(len(recording.cameras) for recording in recordings), 0
    for number, recording in enumerate(recordings):
        for camera, pictures in recording.cameras.items():
            tell(Step("placing", done, total, "camera"))
            found = sight(landmarks, taken(pictures, given), fov_deg)
            if isinstance(found, Sighting):
                histories[camera] = extended(histories.get(camera, ()), number, found)
            else:
                not_seen.setdefault(camera, {})[number] = found
            done += 1
    histories = {camera: histories[camera] for camera in sorted(histories)}
    names = tuple(recording.name for recording in recordings)
    unreadable = {number: each.problem for number, each in enumerate(recordings) if each.problem}
    return Audit(names, histories, not_seen, unreadable, moves(histories), landmarks.unit, landmarks.metric)
