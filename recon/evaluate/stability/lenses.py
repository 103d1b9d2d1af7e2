"""Rows 19 to 22: what is said about the camera is wrong, or the frames are not of one pinhole camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses.wide_pinhole import wide_pinhole
from splatnode.recon.evaluate.stability import warps
from splatnode.recon.evaluate.stability.case import TrialCase, make_accept_case, make_either_case, make_refuse_case, row
from splatnode.recon.evaluate.stability.places import Sampler, TrialImage
from splatnode.recon.evaluate.truth import TrueCamera
from splatnode.recon.result.verdict import Code

_SIDES = 640, 480  # pixels, of photographs through a fisheye
_DOUBTS = (Code.FOCAL_SUSPECT, Code.MIXED_CAMERAS, Code.AMBIGUOUS, Code.BASELINE_TOO_SMALL)


@row(19, "true focal length given")
def true_focal(sampler: Sampler) -> TrialCase:
    photos = _set_focal_length(sampler.load_images(4), 1.0, "given")
    return make_accept_case(photos, "4 frames with their true focal length")


@row(19, "wrong focal length given")
def wrong_focal(sampler: Sampler) -> TrialCase:
    factor = (0.7, 1.4)[sampler.seed % 2]
    photos = _set_focal_length(sampler.load_images(5), factor, "given")
    return make_refuse_case(photos, f"given focal length x{factor}", Code.FOCAL_SUSPECT)


@row(19, "EXIF lies")
def exif_lies(sampler: Sampler) -> TrialCase:
    factor = (0.7, 1.4)[sampler.seed % 2]
    photos = _set_focal_length(sampler.load_images(5), factor, "exif")
    return make_either_case(photos, f"EXIF focal length x{factor}", *_DOUBTS)


@row(20, "radial distortion")
def distortion(sampler: Sampler) -> TrialCase:
    k1 = (-0.1, 0.1)[sampler.seed % 2]
    photos = [warps.distort_image(photo, k1) for photo in sampler.load_images(5)]
    return make_accept_case(photos, f"k1 {k1:+}", Code.OK_PARTIAL)


@row(20, "strong radial distortion")
def strong_distortion(sampler: Sampler) -> TrialCase:
    k1 = (-0.3, 0.3)[sampler.seed % 2]
    photos = [warps.distort_image(photo, k1) for photo in sampler.load_images(5)]
    return make_either_case(photos, f"k1 {k1:+}", *_DOUBTS)


@row(20, "calibrated fisheye")
def fisheye(sampler: Sampler) -> TrialCase:
    """The built-in place, through a fisheye: no recorded scene has one whose cameras are known."""
    across_deg, views = (120.0, 170.0)[sampler.seed % 2], (6, 8)[sampler.seed // 2 % 2]
    focal = _SIDES[0] / math.radians(across_deg)
    lens = Intrinsics(*_SIDES, focal, focal, _SIDES[0] / 2, _SIDES[1] / 2, "calibration", model="fisheye")
    config = synthetic.Config(views=views, seed=sampler.seed, lens=lens)
    pinhole = wide_pinhole("the photograph", lens)
    photos = []
    for index, (T_world_camera, _) in enumerate(cameras := synthetic.scene_cameras(config)):
        image = synthetic.render_image(config, cameras[index], index)
        camera = TrueCamera(T_world_camera, pinhole.K, pinhole.width, pinhole.height)
        photos.append(TrialImage(synthetic.frame_name(index), image, camera, "built-in", lens))
    return make_accept_case(photos, f"through {across_deg:g} degrees")


@row(21, "rolling shutter")
def rolling_shutter(sampler: Sampler) -> TrialCase:
    shift = (0.002, 0.01)[sampler.seed % 2]
    photos = [
        warps.apply_rolling_shutter(photo, shift * (-1) ** number)
        for number, photo in enumerate(sampler.load_images(4))
    ]
    note = f"rows shifted by {shift:.1%} in turns"
    return (
        make_accept_case(photos, note)
        if sampler.seed % 2 == 0
        else make_either_case(photos, note, Code.BLUR, *_DOUBTS, Code.MOVING_SCENE)
    )


@row(22, "portrait and landscape")
def portrait_and_landscape(sampler: Sampler) -> TrialCase:
    photos = [warps.rotate_image(photo) if number % 2 else photo for number, photo in enumerate(sampler.load_images(4))]
    return make_accept_case(photos, "2 on their side", Code.OK_PARTIAL)


@row(22, "two resolutions")
def two_resolutions(sampler: Sampler) -> TrialCase:
    photos = [
        warps.resize_image(photo, 0.6) if number % 2 else photo for number, photo in enumerate(sampler.load_images(4))
    ]
    return make_accept_case(photos, "2 at 60 %", Code.OK_PARTIAL)


@row(22, "crops")
def crops(sampler: Sampler) -> TrialCase:
    rng = sampler.rng
    photos = [
        warps.crop_image(photo, 0.75, *rng.uniform(size=2)) if number % 2 else photo
        for number, photo in enumerate(sampler.load_images(5))
    ]
    return make_either_case(photos, "2 cropped off-centre to 75 %", *_DOUBTS)


def _set_focal_length(photos: Sequence[TrialImage], factor: float, source: str) -> list[TrialImage]:
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
