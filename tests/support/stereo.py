"""The built-in capture with a second camera: what it sees at once, to the right of the first."""

from __future__ import annotations

from collections.abc import Sequence

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame
from tests.support.marked import Marker, photographs


def right_photographs(config: synthetic.Config, baseline_m: float, markers: Sequence[Marker] = ()) -> list[Frame]:
    """The partners of the photographs of `config`, rectified: the right camera has the left one's axes and lens."""
    cameras = [synthetic.offset_right_camera(camera, baseline_m) for camera in synthetic.scene_cameras(config)]
    return photographs(config, cameras, markers, first_seed=1000)
