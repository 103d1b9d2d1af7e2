"""What keys, verbs and flags of recon and the viewer were called in the release before; they are read in this one.

The tables go with the next release. A key stands as "section.former", and its present name stands in the same section
(capture/process/config.py); sections above it are by their present names.
"""

from __future__ import annotations

NODE_KEYS = {
    "settle_s": "idle_finalize_s",
    "lost_after": "new_submap_after",
    "fallback_s": "fallback_timeout_s",
    "export_every_s": "export_interval_s",
    "status_every_s": "status_interval_s",
    "tracking.every_s": "interval_s",
    "map": "occupancy",
}
KEYS = {
    "quick": "no_fallbacks",
    "ladder": "fallbacks",
    "fallbacks.work": "budget",
    "fallbacks.most_s": "timeout_s",
    "light": "exposure_compensation",
    "denied": "transient_mask",
    "seeding": "initialization",
    "screening.limits.blur_px": "max_blur_px",
    "screening.limits.exposed": "min_exposed_share",
    "screening.limits.novelty": "min_novelty",
    "matching.moving": "dynamic_objects",
    "matching.features.num_features": "max_num_features",
    "matching.features.max_longer_side": "max_image_size",
    "decision.require_percent": "max_position_error_percent",
    "metric.marker_m": "marker_size_m",
    "metric.marker_sigma_m": "marker_size_sigma_m",
    "metric.motions_shared": "odometry_scale_sigma",
    "metric.motions_drift": "odometry_drift",
    "metric.motions_sigma_deg": "odometry_sigma_deg",
    "metric.stereo_m": "stereo_baseline_m",
    "metric.stereo_sigma_m": "stereo_baseline_sigma_m",
    "metric.network": "depth_network",
    "metric.network_sigma": "depth_network_sigma",
} | {
    f"{stage}.{former}": present
    for stage in ("preview", "optimize")
    for former, present in (("dssim", "ssim_lambda"), ("rates", "lr"), ("regularise", "regularizers"))
}
_RECONSTRUCTION_FLAGS = {
    "--quick": "--no-fallbacks",
    "--require": "--max-position-error",
    "--only-seen": "--multi-view-only",
}
VERBS = {
    "map": "occupancy",
    "retract": "remove-keyframe",
    "stability": "robustness",
}
FLAGS = {
    "replay": _RECONSTRUCTION_FLAGS | {"--calibration": "--intrinsics", "--poses-only-check": "--check-poses"},
    "batch": _RECONSTRUCTION_FLAGS,
    "export": {"--only-seen": "--multi-view-only"},
    "locate": {"--calibration": "--intrinsics"},
    "audit": {"--calibration": "--intrinsics"},
    "view": {"--photographs": "--images", "--pictures": "--num-frames", "--until-final": "--exit-when-final"},
    "bench": {
        "--interpolated-start": "--interpolate-start",
        "--best-gain": "--color-correct",
        "--by-region": "--score-regions",
    },
    "robustness": {"--told": "--known-lens", "--fresh": "--no-cache", "--per-kind": "--windows-per-kind"},
}
