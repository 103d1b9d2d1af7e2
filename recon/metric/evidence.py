"""What photographs themselves tell of metres, gathered before the scene is known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import DepthImage
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.lenses import straighten_depth
from splatnode.capture.odometry import GivenPose, Gravity, Motion
from splatnode.capture.process.terminal import ProgressStep, Tell, ignore_progress
from splatnode.recon.metric.markers import MarkerDetection, detect_markers
from splatnode.recon.metric.measurement import MetricConfig
from splatnode.recon.metric.stereo import StereoPair, make_own_pair


@dataclass(frozen=True, eq=False)
class CameraDepth:
    """A depth image, and the id of the camera that it is beside; empty: there is one."""

    camera_id: str
    depth: DepthImage


@dataclass(frozen=True, eq=False)
class Evidence:
    """The scale evidence found in images, whether or not they get cameras."""

    sightings: tuple[MarkerDetection, ...] = ()  # of printed markers
    # T_world_camera (4, 4) in metres that others estimated, by photograph; None: no poses were given
    poses: Mapping[str, npt.NDArray[np.float64]] | None = None
    pairs: tuple[StereoPair, ...] = ()  # of stereo cameras
    tracked: Mapping[str, GivenPose] = field(default_factory=dict)  # that came with the photographs, by photograph
    motions: Mapping[str, Motion] = field(default_factory=dict)  # likewise
    gravities: Mapping[str, Gravity] = field(default_factory=dict)  # likewise
    depths: Mapping[str, CameraDepth] = field(default_factory=dict)  # of depth cameras, likewise
    # T_base_camera (4, 4) in metres: where the photograph's camera stands on the robot's base, likewise
    mounts: Mapping[str, npt.NDArray[np.float64]] = field(default_factory=dict)

    def merge(self, further: Evidence) -> Evidence:
        """Returns this evidence merged with that of further images."""
        poses = self.poses if further.poses is None else {**(self.poses or {}), **further.poses}
        sightings, pairs = (*self.sightings, *further.sightings), (*self.pairs, *further.pairs)
        tracked, motions = {**self.tracked, **further.tracked}, {**self.motions, **further.motions}
        gravities, depths = {**self.gravities, **further.gravities}, {**self.depths, **further.depths}
        mounts = {**self.mounts, **further.mounts}
        return Evidence(sightings, poses, pairs, tracked, motions, gravities, depths, mounts)


NOTHING = Evidence()


def gather_evidence(
    frames: Iterable[Frame | DroppedFrame], config: MetricConfig, tell: Tell = ignore_progress
) -> Evidence:
    """Gathers the markers that `config` asks for, and the poses, motions, gravity, mounts, right and depth images.

    Raises ValueError where intrinsics cannot be used.
    """
    known = [each for each in frames if isinstance(each, Frame)]
    came = Evidence(
        tracked={each.name: each.given_pose for each in known if each.given_pose is not None},
        motions={each.name: each.motion for each in known if each.motion is not None},
        gravities={each.name: each.gravity for each in known if each.gravity is not None},
        depths={each.name: CameraDepth(each.camera_id, depth) for each in known if (depth := straighten_depth(each))},
        pairs=tuple(pair for pair in map(make_own_pair, known) if pair is not None),
        mounts={each.name: mount for each in known if (mount := each.mount) is not None},
    )
    if config.marker_size_m is None:
        return came
    tell(ProgressStep("looking for markers"))
    return replace(came, sightings=tuple(detect_markers(known, config.marker_dictionary)))
