"""Where the search for a held-out view's pose starts if its true pose may not be used, as publications do it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def interpolate_pose(name: str, order: Sequence[str], cameras: Mapping[str, Array]) -> Array:
    """(4, 4) T_world_camera between the estimated cameras of the photographs before and after `name` in `order`.

    The centre moves evenly along the line between the two, and the rotation evenly about one axis, by the place of
    `name` between them; before the first and after the last it is that camera's. Raises ValueError where no photograph
    of `order` has a camera.
    """
    place = order.index(name)
    known = [index for index, each in enumerate(order) if each in cameras and index != place]
    if not known:
        raise ValueError(f"cameras must have at least one of the {len(order)} photographs, has {sorted(cameras)[:3]}")
    before = max((index for index in known if index < place), default=min(known))
    after = min((index for index in known if index > place), default=max(known))
    first, second = cameras[order[before]], cameras[order[after]]
    share = 0.0 if before == after else (place - before) / (after - before)
    turn = cv2.Rodrigues(first[:3, :3].T @ second[:3, :3])[0]
    T = np.eye(4)
    T[:3, :3] = first[:3, :3] @ cv2.Rodrigues(share * turn)[0]
    T[:3, 3] = (1 - share) * first[:3, 3] + share * second[:3, 3]
    return T
