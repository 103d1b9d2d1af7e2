"""levels.json: which coarser files of a scene there are, and from how far away each suffices."""

from __future__ import annotations

from collections.abc import Sequence

from splatnode.recon.result.coarser import DetailLevel
from splatnode.recon.result.snapshot import CameraEstimate

LEVELS_FILE = "levels.json"
_FOCAL = 500.0  # pixels, where there is no camera


def make_levels_record(levels: Sequence[DetailLevel], cameras: Sequence[CameraEstimate]) -> dict[str, object]:
    """Makes the record of the `levels`, finest first, for levels.json and report.json.

    `from_distance`, in the file's unit, is where a camera of `focal_px`, the longest of the scene's, begins to see
    errors below a pixel; for another focal length it is longer or shorter in proportion.
    """
    focal = max((float(camera.K[0, 0]) for camera in cameras), default=_FOCAL)
    return {
        "focal_px": focal,
        "levels": [
            {
                "file": f"levels/{number}.ply",
                "num_gaussians": len(level.gaussians),
                "voxel": level.side,
                "from_distance": level.compute_min_distance(focal),
            }
            for number, level in enumerate(levels, 1)
        ],
    }
