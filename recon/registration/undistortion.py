"""Photographs without the distortion that registration estimated, for all that comes after the poses.

Stereo, seeding, refinement and what is published are those of a pinhole. The poses, their verification and the
landmarks keep the photographs as they were taken, of which the radial coefficients are.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture import lenses as opencv
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses import SQUARE_TOLERANCE, undistort_frame
from splatnode.recon.geometry import distortion
from splatnode.recon.keyframes import Features, Keyframe, resize_image, resize_mask
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.registration import RegisteredCamera, Registration
from splatnode.recon.registration.self_calibration import LEAST_SHIFT

log = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]

_DETAIL = 2  # times the modelled size: what is straightened, so that resampling twice costs no sharpness


def undistort_keyframes(graph: ViewGraph, registration: Registration) -> tuple[ViewGraph, Registration]:
    """Both, as if pinholes had taken the photographs whose lens bends lines enough to be sure of it (LEAST_SHIFT).

    So are photographs whose pixels are not square.

    Such a keyframe has its `lens`; its frame is at most twice as large as it is modelled. Observations beyond what it
    shows are left out. What came is returned where no lens is such, or one is estimated that folds its picture over.
    """
    lenses = {}
    for camera in registration.cameras:
        lens = _make_intrinsics(camera, graph.keyframes[camera.index].frame)
        if abs(corner_shift(lens)) > LEAST_SHIFT or abs(camera.aspect - 1.0) > SQUARE_TOLERANCE:
            lenses[camera.index] = lens
    if not lenses:
        return graph, registration
    keyframes = list(graph.keyframes)
    try:
        for index, lens in lenses.items():
            keyframes[index] = undistort_keyframe(keyframes[index], lens)
    except ValueError as error:
        log.warning("the photographs stay as they are: the estimated lens cannot be: %s", error)
        return graph, registration
    return replace(graph, keyframes=tuple(keyframes)), _undistort_observations(keyframes, registration)


def apply_known_lenses(
    registration: Registration, graph: ViewGraph, known: Mapping[str, Intrinsics | None]
) -> Registration:
    """The registration with lenses that are `known`, by keyframe, of all cameras that share them.

    What continues an estimate has fewer points, which tell less of a lens than those that it was estimated from before.
    """
    lenses = {}
    for camera in registration.cameras:
        keyframe = graph.keyframes[camera.index]
        if (lens := known.get(keyframe.name)) is not None:
            lenses[camera.lens] = lens
    cameras = []
    for camera in registration.cameras:
        if (lens := lenses.get(camera.lens)) is not None:
            frame = graph.keyframes[camera.index].frame
            own = lens.resized(frame.width, frame.height)
            principal = np.array([own.cx, own.cy])
            camera = replace(
                camera, focal=own.fx, aspect=own.fy / own.fx, principal=principal, radial=np.array(radial_of(own))
            )
        cameras.append(camera)
    return replace(registration, cameras=tuple(cameras))


def undistort_keyframe(keyframe: Keyframe, lens: Intrinsics) -> Keyframe:
    """The keyframe as a pinhole would have seen it. Raises ValueError where `lens` folds its picture over."""
    height, width = keyframe.image.shape[:2]
    image = resize_image(keyframe.frame.image, _DETAIL * max(width, height))
    mask = keyframe.frame.mask
    mask = None if mask is None else resize_mask(mask, *image.shape[:2])
    frame = undistort_frame(replace(keyframe.frame, image=image, mask=mask, intrinsics=lens))
    shown = frame.image
    if shown.shape[:2] != (height, width):
        shown = cv2.resize(shown, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    points = undistort_pixels(keyframe.features.points, lens, _pinhole(frame))
    return Keyframe(frame, shown, _replace_points(keyframe.features, points), lens, keyframe.moving)


def undistort_pixels(pixels: Array, lens: Intrinsics, pinhole: Intrinsics) -> Array:
    """(M, 2) where `pinhole` shows what `lens` shows at `pixels` (M, 2), each in pixels of its own picture."""
    return opencv.project_opencv(opencv.unproject_opencv(pixels, lens), pinhole) if len(pixels) else pixels


def corner_shift(lens: Intrinsics | None) -> float:
    """Returns how far distortion moves the corner farthest from the principal point, over the longer side.

    Above 0 away from that point; 0 without a lens.
    """
    if lens is None or not lens.distortion:
        return 0.0
    across = max(lens.cx, lens.width - lens.cx) / lens.fx
    down = max(lens.cy, lens.height - lens.cy) / lens.fy
    corner = np.hypot(across, down)
    moved = distortion(corner**2, np.array(radial_of(lens))) - 1.0
    return float(moved * corner * lens.fx / max(lens.width, lens.height))


def radial_of(lens: Intrinsics | None) -> tuple[float, float]:
    """The radial coefficients of a lens that registration estimated; without one, those of a pinhole."""
    if lens is None or not lens.distortion:
        return 0.0, 0.0
    first, second, *_ = (*lens.distortion, 0.0)
    return first, second


def _make_intrinsics(camera: RegisteredCamera, frame: Frame) -> Intrinsics:
    cx, cy = (float(value) for value in camera.principal)
    radial = (*camera.radial.tolist(), 0.0, 0.0) if camera.radial.any() else ()
    fx, fy = (float(value) for value in camera.focals)
    return Intrinsics(frame.width, frame.height, fx, fy, cx, cy, "estimated", radial)


def _undistort_observations(keyframes: list[Keyframe], registration: Registration) -> Registration:
    """The registration of these keyframes, some of which are straight, in their pixels."""
    pixels, inside = registration.observed_pixels.copy(), np.ones(len(registration.observed_by), bool)
    cameras = []
    for camera in registration.cameras:
        keyframe = keyframes[camera.index]
        if keyframe.lens is None:
            cameras.append(camera)
            continue
        pinhole, own = _pinhole(keyframe.frame), registration.observed_by == camera.index
        pixels[own] = undistort_pixels(pixels[own], keyframe.lens, pinhole)
        inside[own] = np.all((pixels[own] >= 0) & (pixels[own] < (pinhole.width, pinhole.height)), axis=1)
        principal = np.array([pinhole.cx, pinhole.cy])
        cameras.append(replace(camera, focal=pinhole.fx, principal=principal, radial=np.zeros(2), aspect=1.0))
    return replace(
        registration,
        cameras=tuple(cameras),
        observed_by=registration.observed_by[inside],
        observed_point=registration.observed_point[inside],
        observed_pixels=pixels[inside],
    )


def _pinhole(frame: Frame) -> Intrinsics:
    if frame.intrinsics is None:
        raise AssertionError("a straightened frame has the intrinsics of its pinhole")
    return frame.intrinsics


def _replace_points(features: Features, points: Array) -> Features:
    return Features(points, features.descriptors, features.point_of, features.tilt)
