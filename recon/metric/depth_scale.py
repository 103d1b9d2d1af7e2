"""The unit by depth images: their depths over those of the scene's points, checked by the images and other sources."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from splatnode.recon.metric.depth_fit import DepthFit, DepthView, fit_depth_images, merge_lens
from splatnode.recon.metric.evidence import CameraDepth
from splatnode.recon.metric.measurement import (
    MAX_DEVIATION,
    Measurement,
    MetricView,
    combine_measurements,
    compute_scale_sigma,
)
from splatnode.recon.result.depth_check import DepthCheck, DepthCode
from splatnode.recon.result.snapshot import Landmarks


def estimate_scale_from_depth(
    views: Mapping[str, MetricView],
    landmarks: Landmarks | None,
    depths: Mapping[str, CameraDepth],
    others: Sequence[Measurement],
) -> tuple[list[Measurement | str], tuple[DepthCheck, ...]]:
    """The unit by the depth images of each camera, or why there is none; and the judgement on each camera's.

    `others` is what further sources measured. Where these agree, and depths have another unit by MAX_DEVIATION standard
    deviations, the depth camera is named with its error, and gives no unit.
    """
    if not depths:
        return [], ()
    if landmarks is None:
        message = f"depth images of {len(depths)} photographs were given, and the scene has no points to compare with"
        return [message], (DepthCheck(DepthCode.UNTESTED, message),)
    fits = fit_depth_images(
        [
            _make_depth_view(name, view, landmarks, depths[name])
            for name, view in views.items()
            if name in depths and name in landmarks.names
        ]
    )
    of_scene = compute_scale_sigma(list(views.values()))
    agreed = combine_measurements(others) if others else None
    told = [_measure(fit, of_scene, agreed if isinstance(agreed, Measurement) else None) for fit in fits]
    return [said for said, _ in told], tuple(check for _, check in told)


def _make_depth_view(name: str, view: MetricView, landmarks: Landmarks, own: CameraDepth) -> DepthView:
    number = landmarks.names.index(name)
    points = landmarks.points[np.unique(landmarks.point_of[landmarks.photograph_of == number])]
    in_camera = (points - view.centre) @ view.T_world_camera[:3, :3]
    lens = merge_lens(view.focal, view.radial, view.shift, own.depth)
    return DepthView(name, own.camera_id, in_camera, own.depth, lens)


def _measure(fit: DepthFit, of_scene: float, agreed: Measurement | None) -> tuple[Measurement | str, DepthCheck]:
    check = fit.check
    if not fit.is_usable:
        return check.message, check
    who = f"depth images of {len(fit.names)} photographs" + (f" of {fit.camera_id}" if fit.camera_id else "")
    measured = Measurement(fit.metres_per_unit, math.hypot(fit.sigma, of_scene), who)
    if agreed is None:
        return measured, check
    error = measured.metres_per_unit / agreed.metres_per_unit - 1.0
    spread = math.hypot(measured.sigma, agreed.sigma)
    if abs(math.log1p(error)) <= MAX_DEVIATION * spread:
        return measured, check
    message = (
        f"{who} are {100 * abs(error):.1f} % too {'large' if error > 0 else 'small'} by {agreed.source} "
        f"({abs(math.log1p(error)) / spread:.1f} standard deviations), so they give no metres; their shape is used. "
        "Calibrate the depth camera, or measure the other again"
    )
    return message, replace(check, code=DepthCode.SCALE, message=message, scale_error=float(error))
