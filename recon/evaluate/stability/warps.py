"""What another lens, another way to hold the camera, or another camera would have seen: photographs with new cameras.

Pixels are sampled from the photograph, so each function says what it takes from outside of it: nothing, or grey.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.evaluate.stability.places import Image, TrialImage
from splatnode.recon.evaluate.truth import TrueCamera
from splatnode.recon.geometry import distortion

Array = npt.NDArray[np.float64]

_PIXEL_CENTRE = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # from OpenCV's pixels to ours


def warp_image(image: Image, homography: Array, width: int, height: int) -> Image:
    """`image` through `homography` (3, 3), in pixels whose first centre is (0.5, 0.5); grey where it does not reach."""
    own = np.linalg.inv(_PIXEL_CENTRE) @ homography @ _PIXEL_CENTRE
    grey = (128.0, 128.0, 128.0)
    return cv2.warpPerspective(image, own, (width, height), flags=cv2.INTER_CUBIC, borderValue=grey).astype(np.uint8)


def render_turned_crops(photo: TrialImage, yaws_deg: Array, pitches_deg: Array) -> list[TrialImage]:
    """Views of half the width and height by a camera that turns where `photo` was taken: exactly K R K^-1.

    Angles are reduced where they would leave the photograph.
    """
    camera = _require_camera(photo)
    width, height = camera.width // 2, camera.height // 2
    K = camera.K.copy()
    K[:2, 2] = width / 2.0, height / 2.0
    # A rotated crop's far corner is further from the axis than the angle alone: 0.8 keeps it inside.
    limits = [0.8 * np.degrees(np.arctan(side / 4.0 / camera.K[0, 0])) for side in (camera.width, camera.height)]
    crops = []
    for number, (yaw, pitch) in enumerate(zip(yaws_deg, pitches_deg, strict=True)):
        angles = np.clip([yaw, pitch], [-limits[0], -limits[1]], limits)
        R_turned_camera = _compute_rotation(np.array([angles[1], -angles[0], 0.0]))
        image = warp_image(photo.image, K @ R_turned_camera @ np.linalg.inv(camera.K), width, height)
        T_world_camera = camera.T_world_camera.copy()
        T_world_camera[:3, :3] = T_world_camera[:3, :3] @ R_turned_camera.T
        crops.append(
            TrialImage(f"turned_{number}.png", image, TrueCamera(T_world_camera, K, width, height), photo.place)
        )
    return crops


def render_poster_views(poster: TrialImage, azimuths_deg: Array, distance: float = 1.0) -> list[TrialImage]:
    """The image of `poster`, as wide as 2 units and flat, seen from an arc around its middle; grey beyond."""
    width, height, focal = 800, 600, 720.0
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    rows, columns = poster.image.shape[:2]
    unit = 2.0 / columns
    T_plane_pixel = np.array([[unit, 0.0, -1.0], [0.0, unit, -unit * rows / 2.0], [0.0, 0.0, 1.0]])
    views = []
    for number, azimuth in enumerate(azimuths_deg):
        R_world_camera = _compute_rotation(np.array([3.0 * np.sin(number), azimuth, 2.0 * np.cos(number)]))
        centre = -distance * R_world_camera[:, 2]
        R_camera_world = R_world_camera.T
        plane_to_camera = np.stack([R_camera_world[:, 0], R_camera_world[:, 1], -R_camera_world @ centre], 1)
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3], T_world_camera[:3, 3] = R_world_camera, centre
        image = warp_image(poster.image, K @ plane_to_camera @ T_plane_pixel, width, height)
        camera = TrueCamera(T_world_camera, K, width, height)
        views.append(TrialImage(f"poster_{number}.png", image, camera, poster.place))
    return views


def mirror_image(photo: TrialImage) -> TrialImage:
    """The photograph's mirror image: what its camera would have seen in the mirrored world."""
    camera = _require_camera(photo)
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    K = camera.K.copy()
    K[0, 2] = camera.width - K[0, 2]
    seen = replace(camera, T_world_camera=flip @ camera.T_world_camera @ flip, K=K)
    return replace(photo, name=f"mirrored_{photo.name}", image=np.ascontiguousarray(photo.image[:, ::-1]), camera=seen)


def rotate_image(photo: TrialImage) -> TrialImage:
    """The photograph turned by 90 degrees clockwise, and its camera with it."""
    camera = _require_camera(photo)
    turn = np.eye(4)
    turn[:3, :3] = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # new x is the old -y, new y the old x
    K = camera.K.copy()
    K[0, 0], K[1, 1] = camera.K[1, 1], camera.K[0, 0]
    K[0, 2], K[1, 2] = camera.height - camera.K[1, 2], camera.K[0, 2]
    seen = TrueCamera(camera.T_world_camera @ turn, K, camera.height, camera.width)
    return replace(photo, image=np.ascontiguousarray(np.rot90(photo.image, -1)), camera=seen)


def resize_image(photo: TrialImage, share: float) -> TrialImage:
    height, width = (round(share * side) for side in photo.image.shape[:2])
    camera = _require_camera(photo)
    image = cv2.resize(photo.image, (width, height), interpolation=cv2.INTER_AREA if share < 1 else cv2.INTER_CUBIC)
    return replace(
        photo, image=image.astype(np.uint8), camera=_make_camera(camera, camera.K_for(width, height), image.shape)
    )


def crop_image(photo: TrialImage, share: float, left: float, top: float) -> TrialImage:
    """`share` of the width and height; `left` and `top` in [0, 1] say where between the two edges."""
    height, width = photo.image.shape[:2]
    x, y = round(left * (1 - share) * width), round(top * (1 - share) * height)
    image = np.ascontiguousarray(photo.image[y : y + round(share * height), x : x + round(share * width)])
    camera = _require_camera(photo)
    K = camera.K.copy()
    K[:2, 2] -= x, y
    return replace(photo, image=image, camera=_make_camera(camera, K, image.shape))


def distort_image(photo: TrialImage, k1: float, k2: float = 0.0) -> TrialImage:
    """As a lens with these radial coefficients shows it; enlarged just enough that nothing is missing."""
    camera = _require_camera(photo)
    height, width = photo.image.shape[:2]
    corner = np.hypot(camera.K[0, 2] / camera.K[0, 0], camera.K[1, 2] / camera.K[1, 1])
    radials = np.array([k1, k2])
    K = np.diag([*[max(1.0, 1.0 / float(distortion(corner**2, radials)))] * 2, 1.0]) @ camera.K
    K[:2, 2] = camera.K[:2, 2]
    across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    seen = np.stack([(across - K[0, 2]) / K[0, 0], (down - K[1, 2]) / K[1, 1]], -1)
    true = seen.copy()
    for _ in range(20):  # a fixed point
        true = seen / distortion((true**2).sum(-1), radials)[..., None]
    source = (true * [camera.K[0, 0], camera.K[1, 1]] + camera.K[:2, 2] - 0.5).astype(np.float32)
    image = cv2.remap(photo.image, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return replace(photo, image=image.astype(np.uint8), camera=_make_camera(camera, K, image.shape))


def apply_rolling_shutter(photo: TrialImage, shift: float) -> TrialImage:
    """Read out row by row while the camera panned: the last row is `shift` times the width further than the first."""
    height, width = photo.image.shape[:2]
    across, down = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    source = across + np.float32(shift * width) * (down / np.float32(height) - np.float32(0.5))
    image = cv2.remap(photo.image, source, down, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return replace(photo, image=image.astype(np.uint8))


def _make_camera(camera: TrueCamera, K: Array, shape: Sequence[int]) -> TrueCamera:
    """The camera with the intrinsics `K` of an image of `shape` (H, W, ...)."""
    return TrueCamera(camera.T_world_camera, K, shape[1], shape[0])


def _require_camera(photo: TrialImage) -> TrueCamera:
    if photo.camera is None:
        raise ValueError(f"{photo.name} must have a true camera to be warped")
    return photo.camera


def _compute_rotation(degrees: Array) -> Array:
    return np.asarray(cv2.Rodrigues(np.radians(degrees))[0], np.float64)
