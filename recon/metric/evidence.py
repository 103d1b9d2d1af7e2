"""What photographs themselves tell of metres, gathered before the scene is known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.given_pose import GivenPose
from splatnode.capture.process.progress import Step, Tell, told_to_nobody
from splatnode.recon.metric.config import Config
from splatnode.recon.metric.marker_detection import Sighting, sightings
from splatnode.recon.metric.stereo_pairs import Pair, pair_with


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was found in photographs, whatever becomes of them."""

    sightings: tuple[Sighting, ...] = ()  # of printed markers
    # T_world_camera (4, 4) in metres that others estimated, by photograph; None: no poses were given
    poses: Mapping[str, npt.NDArray[np.float64]] | None = None
    pairs: tuple[Pair, ...] = ()  # of stereo cameras
    tracked: Mapping[str, GivenPose] = field(default_factory=dict)  # that came with the photographs, by photograph

    def and_also(self, further: Evidence) -> Evidence:
        """With what further photographs tell."""
        poses = self.poses if further.poses is None else {**(self.poses or {}), **further.poses}
        tracked = {**self.tracked, **further.tracked}
        return Evidence((*self.sightings, *further.sightings), poses, (*self.pairs, *further.pairs), tracked)


NOTHING = Evidence()


def gathered(frames: Iterable[Frame | DroppedFrame], config: Config, tell: Tell = told_to_nobody) -> Evidence:
    """What the frames tell of what `config` asks for, and the poses and right images that came with them.

    Raises ValueError where intrinsics cannot be used.
    """
    known = [each for each in frames if isinstance(each, Frame)]
    tracked = {each.name: each.given_pose for each in known if each.given_pose is not None}
    paired = tuple(pair for pair in map(pair_with, known) if pair is not None)
    if config.marker_m is None:
        return Evidence(tracked=tracked, pairs=paired)
    tell(Step("looking for markers"))
    return Evidence(tuple(sightings(known, config.marker_dictionary)), tracked=tracked, pairs=paired)
