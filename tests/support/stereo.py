"""The built-in capture with a second camera: what it sees at once, to the right of the first."""

from __future__ import annotations

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame


def right_photographs(config: synthetic.Config, baseline_m: float) -> list[Frame]:
    """The partners of the photographs of `config`, rectified: the right camera has the left one's axes and lens."""
    frames = []
    for index, (T_world_camera, K) in enumerate(synthetic.scene_cameras(config)):
        beside = T_world_camera.copy()
        beside[:3, 3] += baseline_m * T_world_camera[:3, 0]
        image = synthetic.photograph(config, (beside, K), noise_seed=1000 + index)
        frames.append(Frame(index, synthetic.frame_name(index), index * 500_000_000, image, intrinsics=None))
    return frames
