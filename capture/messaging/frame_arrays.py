"""The pixels of a frame as arrays of a message: its image, then its mask and its right image, where it has these."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt
from msgspec import UNSET, UnsetType

from splatnode.capture.exposure_settings import ExposureSettings
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.given_pose import GivenPose
from splatnode.capture.gravity import Gravity
from splatnode.capture.left_out import read_optional_field
from splatnode.capture.motion import Motion
from splatnode.capture.right_image import Baseline, RightImage
from splatnode.capture.stamp import Stamp

Array = npt.NDArray[np.generic]


class FrameFields(Protocol):
    """The fields of a header that describe a frame, beside its arrays."""

    @property
    def name(self) -> str: ...
    @property
    def stamp_ns(self) -> int: ...
    @property
    def intrinsics(self) -> Intrinsics | None: ...
    @property
    def captured_at(self) -> Stamp | None: ...
    @property
    def given_pose(self) -> GivenPose | UnsetType: ...
    @property
    def motion(self) -> Motion | UnsetType: ...
    @property
    def gravity(self) -> Gravity | UnsetType: ...
    @property
    def exposure(self) -> ExposureSettings | UnsetType: ...
    @property
    def baseline(self) -> Baseline | UnsetType: ...


def arrays_of(frame: Frame) -> list[Array]:
    """The image (H, W, 3), the mask (H, ceil(W / 8)), first pixel in the highest bit, and the right image (H, W)."""
    mask = [] if frame.mask is None else [np.packbits(frame.mask, axis=1)]
    right = [] if frame.right is None else [frame.right.image]
    return [frame.image, *mask, *right]


def frame_in(header: FrameFields, frame_id: int, arrays: Sequence[npt.NDArray]) -> Frame:
    """The frame of which `arrays_of` gave the arrays; it has a right image if its header tells a baseline.

    Raises ValueError where they are not that: the mask's and the right image's size must be the image's.
    """
    rights = 0 if header.baseline is UNSET else 1
    if len(arrays) - rights not in (1, 2):
        also = ", with a baseline one right image" if rights else ""
        raise ValueError(f"a frame has one image and at most one mask{also}; got {len(arrays)} arrays")
    image, masks = arrays[0], arrays[1 : len(arrays) - rights]
    return Frame(
        frame_id,
        header.name,
        header.stamp_ns,
        image,
        header.intrinsics,
        captured_at=header.captured_at,
        mask=_mask(image, masks[0]) if masks else None,
        given_pose=read_optional_field(header.given_pose),
        motion=read_optional_field(header.motion),
        gravity=read_optional_field(header.gravity),
        exposure=read_optional_field(header.exposure),
        right=None if header.baseline is UNSET else RightImage(arrays[-1], header.baseline),
    )


def _mask(image: npt.NDArray, bits: npt.NDArray) -> npt.NDArray[np.bool_]:
    height, width = image.shape[:2] if image.ndim >= 2 else (0, 0)
    if bits.dtype != np.uint8 or bits.shape != (height, (width + 7) // 8):
        raise ValueError(
            f"the mask of an image {width} x {height} must be ({height}, {(width + 7) // 8}) uint8, a bit a pixel, "
            f"got {bits.shape} {bits.dtype}"
        )
    return np.unpackbits(bits, axis=1, count=width).astype(bool)
