"""Rows 19 to 22: what is said about the camera is wrong, or the frames are not of one pinhole camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses.wide_pinhole import wide_pinhole
from splatnode.recon.evaluate.stability import warps
from splatnode.recon.evaluate.stability.case import Case, accepted, either, refused, row
from splatnode.recon.evaluate.stability.places import Photo, Sampler
from splatnode.recon.evaluate.truth import TrueCamera
from splatnode.recon.result.verdict import Code

_SIDES = 640, 480  # pixels, of photographs through a fisheye
_DOUBTS = (Code.FOCAL_SUSPECT, Code.MIXED_CAMERAS, Code.AMBIGUOUS, Code.BASELINE_TOO_SMALL)


@row(19, "true focal length given")
def true_focal(sampler: Sampler) -> Case:
    photos = _with_focal_length(sampler.photos(4), 1.0, "given")
    return accepted(photos, "4 frames with their true focal length")


@row(19, "wrong focal length given")
def wrong_focal(sampler: Sampler) -> Case:
    factor = (0.7, 1.4)[sampler.seed % 2]
    photos = _with_focal_length(sampler.photos(5), factor, "given")
    return refused(photos, f"given focal length x{factor}", Code.FOCAL_SUSPECT)


@row(19, "EXIF lies")
def exif_lies(sampler: Sampler) -> Case:
    factor = (0.7, 1.4)[sampler.seed % 2]
    photos = _with_focal_length(sampler.photos(5), factor, "exif")
    return either(photos, f"EXIF focal length x{factor}", *_DOUBTS)


@row(20, "radial distortion")
def distortion(sampler: Sampler) -> Case:
    k1 = (-0.1, 0.1)[sampler.seed % 2]
    photos = [warps.distorted(photo, k1) for photo in sampler.photos(5)]
    return accepted(photos, f"k1 {k1:+}", Code.OK_PARTIAL)


@row(20, "strong radial distortion")
def strong_distortion(sampler: Sampler) -> Case:
    k1 = (-0.3, 0.3)[sampler.seed % 2]
    photos = [warps.distorted(photo, k1) for photo in sampler.photos(5)]
    return either(photos, f"k1 {k1:+}", *_DOUBTS)


@row(20, "calibrated fisheye")
def fisheye(sampler: Sampler) -> Case:
    """The built-in place, through a fisheye: no recorded scene has one whose cameras are known."""
    across_deg, views = (120.0, 170.0)[sampler.seed % 2], (6, 8)[sampler.seed // 2 % 2]
    focal = _SIDES[0] / math.radians(across_deg)
    lens = Intrinsics(*_SIDES, focal, focal, _SIDES[0] / 2, _SIDES[1] / 2, "calibration", model="fisheye")
    config = synthetic.Config(views=views, seed=sampler.seed, lens=lens)
    pinhole = wide_pinhole("the photograph", lens)
    photos = []
    for index, (T_world_camera, _) in enumerate(cameras := synthetic.scene_cameras(config)):
        image = synthetic.photograph(config, cameras[index], index)
        camera = TrueCamera(T_world_camera, pinhole.K, pinhole.width, pinhole.height)
        photos.append(Photo(synthetic.frame_name(index), image, camera, "built-in", lens))
    return accepted(photos, f"through {across_deg:g} degrees")


@row(21, "rolling shutter")
def rolling_shutter(sampler: Sampler) -> Case:
    shift = (0.002, 0.01)[sampler.seed % 2]
    photos = [warps.rolled(photo, shift * (-1) ** number) for number, photo in enumerate(sampler.photos(4))]
    note = f"rows shifted by {shift:.1%} in turns"
    return (
        accepted(photos, note)
        if sampler.seed % 2 == 0
        else either(photos, note, Code.BLUR, *_DOUBTS, Code.MOVING_SCENE)
    )


@row(22, "portrait and landscape")
def turned(sampler: Sampler) -> Case:
    photos = [warps.on_its_side(photo) if number % 2 else photo for number, photo in enumerate(sampler.photos(4))]
    return accepted(photos, "2 on their side", Code.OK_PARTIAL)


@row(22, "two resolutions")
def two_resolutions(sampler: Sampler) -> Case:
    photos = [warps.resized(photo, 0.6) if number % 2 else photo for number, photo in enumerate(sampler.photos(4))]
    return accepted(photos, "2 at 60 %", Code.OK_PARTIAL)


@row(22, "crops")
def crops(sampler: Sampler) -> Case:
    rng = sampler.rng
    photos = [
        warps.cropped(photo, 0.75, *rng.uniform(size=2)) if number % 2 else photo
        for number, photo in enumerate(sampler.photos(5))
    ]
    return either(photos, "2 cropped off-centre to 75 %", *_DOUBTS)


def _with_focal_length(photos: Sequence[Photo], factor: float, source: str) -> list[Photo]:
    """The photographs with their true focal length times `factor` as what `source` says of them."""
    changed = []
    for photo in photos:
        if photo.camera is None:
            raise ValueError(f"{photo.name} must have a true camera")
        height, width = photo.image.shape[:2]
        K = photo.camera.K_for(width, height)
        focal = factor * K[0, 0], factor * K[1, 1]
        changed.append(replace(photo, intrinsics=Intrinsics(width, height, *focal, K[0, 2], K[1, 2], source)))
    return changed
