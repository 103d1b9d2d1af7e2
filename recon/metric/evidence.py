"""What photographs themselves tell of metres, gathered before the scene is known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.given_pose import GivenPose
from splatnode.capture.gravity import Gravity
from splatnode.capture.motion import Motion
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
    motions: Mapping[str, Motion] = field(default_factory=dict)  # likewise
    gravities: Mapping[str, Gravity] = field(default_factory=dict)  # likewise

    def and_also(self, further: Evidence) -> Evidence:
        """With what further photographs tell."""
        poses = self.poses if further.poses is None else {**(self.poses or {}), **further.poses}
        sightings, pairs = (*self.sightings, *further.sightings), (*self.pairs, *further.pairs)
        tracked, motions = {**self.tracked, **further.tracked}, {**self.motions, **further.motions}
        return Evidence(sightings, poses, pairs, tracked, motions, {**self.gravities, **further.gravities})


NOTHING = Evidence()


def gathered(frames: Iterable[Frame | DroppedFrame], config: Config, tell: Tell = told_to_nobody) -> Evidence:
    """What the frames tell of what `config` asks for, and what came with them: poses, motions, gravity, right images.

    Raises ValueError where intrinsics cannot be used.
    """
    known = [each for each in frames if isinstance(each, Frame)]
    came = Evidence(
        tracked={each.name: each.given_pose for each in known if each.given_pose is not None},
        motions={each.name: each.motion for each in known if each.motion is not None},
        gravities={each.name: each.gravity for each in known if each.gravity is not None},
        pairs=tuple(pair for pair in map(pair_with, known) if pair is not None),
    )
    if config.marker_m is None:
        return came
    tell(Step("looking for markers"))
    return replace(came, sightings=tuple(sightings(known, config.marker_dictionary)))
