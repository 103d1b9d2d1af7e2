"""A photograph that follows one that was placed: the same camera, a moment later, found in a fraction of the time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics
from splatnode.recon.locating.locate import Config, described, locate, located
from splatnode.recon.locating.outcome import Located, NotLocated
from splatnode.recon.matching import features
from splatnode.recon.result.landmarks import Landmarks

# Fewer features, of the photograph as it is: what follows is seen from nearly the same place.
_QUICK = Config(features=features.Config(num_features=3000, min_longer_side=0, max_longer_side=1000))
_NEAREST = 4  # photographs of the scene that it is compared with


def follow(
    landmarks: Landmarks,
    image: npt.NDArray[np.uint8],  # (H, W, 3) RGB
    last: Located,
    intrinsics: Intrinsics | None = None,
    config: Config = Config(),  # noqa: B008 (it is frozen)
) -> Located | NotLocated:
    """As `locate`, for an image of the size and the lens of that which `last` is of, taken shortly after it.

    It is compared with the scene's photographs nearest to `last`, and judged as any other; where that refuses it, it is
    looked for as if nothing were known.
    """
    lens = intrinsics or _lens(last, image)
    found = located(landmarks.seen_by(_nearest(landmarks, last)), described(image, lens, _QUICK), _QUICK)
    return found if isinstance(found, Located) else locate(landmarks, image, intrinsics, config)


def _lens(last: Located, image: npt.NDArray[np.uint8]) -> Intrinsics:
    """That of the last photograph, as something nearly known."""
    height, width = image.shape[:2]
    fx, fy, cx, cy = (float(last.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Intrinsics(width, height, fx, fy, cx, cy, source="exif")


def _nearest(landmarks: Landmarks, last: Located) -> npt.NDArray[np.int64]:
    """The photographs of the scene that look most alike: a radian counts as much as the distance to the scene."""
    Ts = landmarks.Ts_world_camera
    turn = np.arccos(np.clip(Ts[:, :3, 2] @ last.T_world_camera[:3, 2], -1.0, 1.0))
    apart = np.linalg.norm(Ts[:, :3, 3] - last.T_world_camera[:3, 3], axis=1) / landmarks.unit
    return np.argsort(turn + apart, kind="stable")[:_NEAREST]
