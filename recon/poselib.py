"""PoseLib's robust estimators of poses; OpenCV's in its place where it is not installed, as it has no wheel there."""

from __future__ import annotations

try:
    from poselib import (  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]
        estimate_absolute_pose,
        estimate_relative_pose,
        estimate_shared_focal_relative_pose,
    )
except ImportError:
    from splatnode.recon.opencv_poses import (
        estimate_absolute_pose,
        estimate_relative_pose,
        estimate_shared_focal_relative_pose,
    )

__all__ = ["estimate_absolute_pose", "estimate_relative_pose", "estimate_shared_focal_relative_pose"]
