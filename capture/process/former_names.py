"""What keys, verbs and flags were called in the release before; they are read in this one.

The tables go with the next release. A key stands as "section.former" or, of one kind of camera alone, as
"section[kind].former", and its present name stands in the same section (config.py beside this file); sections above it
are by their present names. No help lists these names.
"""

from __future__ import annotations

CAPTURE_KEYS = {
    "camera.frames_per_second": "fps",
    "camera.lock": "lock_exposure",
    "camera.settle_s": "warmup_s",
    "camera.silence_s": "frame_timeout_s",
    "camera[v4l2].pixels": "fourcc",
    "camera[video].every": "stride",
    "camera[video].from_s": "start_s",
    "camera[video].to_s": "end_s",
    "camera[watched].existing": "include_existing",
    "camera[watched].settle_s": "stable_s",
    "camera[watched].give_up_s": "file_timeout_s",
    "quality.blur_px": "max_blur_px",
    "quality.exposed": "min_exposed_share",
    "quality.novelty": "min_novelty",
    "selection.per_second": "max_fps",
    "reader.silence_s": "frame_timeout_s",
    "reader.give_up_s": "reconnect_timeout_s",
    "preview.per_second": "fps",
}
NODE_KEYS = {
    "settle_s": "idle_finalize_s",
    "lost_after": "new_submap_after",
    "fallback_s": "fallback_timeout_s",
    "export_every_s": "export_interval_s",
    "status_every_s": "status_interval_s",
    "tracking.every_s": "interval_s",
    "map": "occupancy",
}
RECONSTRUCTION_KEYS = {
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
    "find": "list-cameras",
    "keys": "keygen",
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
    "status": {"--seen": "--acknowledge"},
}
