"""FrameMeta: the one schema of what a frame is beside its arrays."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import UNSET, UnsetType

from splatnode.capture.frame import (
    LARGEST_NUMBER,
    ExposureSettings,
    Frame,
    Intrinsics,
    Stamp,
    make_optional_field,
    read_optional_field,
)
from splatnode.capture.odometry import GivenPose, Gravity, Motion, MountNumbers
from splatnode.capture.process.text import LONGEST_NAME

_Name = Annotated[str, msgspec.Meta(min_length=1, max_length=LONGEST_NAME)]
_Count = Annotated[int, msgspec.Meta(ge=0, le=LARGEST_NUMBER)]


class FrameMeta(msgspec.Struct, frozen=True, kw_only=True):
    """Describes a frame beside its arrays, in messages, checkpoints and recordings alike.

    A field with a default is left out where there is nothing to tell: a reader that does not know it takes every
    frame without it.
    """

    name: _Name
    stamp_ns: _Count
    intrinsics: Intrinsics | None
    captured_at: Stamp | None = None
    given_pose: GivenPose | UnsetType = UNSET
    motion: Motion | UnsetType = UNSET
    gravity: Gravity | UnsetType = UNSET
    exposure: ExposureSettings | UnsetType = UNSET
    camera: _Name | UnsetType = UNSET
    camera_id: _Name | UnsetType = UNSET
    T_base_camera: MountNumbers | UnsetType = UNSET


def describe_frame(frame: Frame) -> dict[str, Any]:
    """Returns the fields of FrameMeta by name."""
    return {
        "name": frame.name,
        "stamp_ns": frame.stamp_ns,
        "intrinsics": frame.intrinsics,
        "captured_at": frame.captured_at,
        "given_pose": make_optional_field(frame.given_pose),
        "motion": make_optional_field(frame.motion),
        "gravity": make_optional_field(frame.gravity),
        "exposure": make_optional_field(frame.exposure),
        "camera": frame.camera or UNSET,
        "camera_id": frame.camera_id or UNSET,
        "T_base_camera": make_optional_field(frame.T_base_camera),
    }


def read_frame_fields(meta: FrameMeta) -> dict[str, Any]:
    """Returns what `Frame` takes of `meta` by name, apart from `name` and `stamp_ns`."""
    return {
        "intrinsics": meta.intrinsics,
        "captured_at": meta.captured_at,
        "given_pose": read_optional_field(meta.given_pose),
        "motion": read_optional_field(meta.motion),
        "gravity": read_optional_field(meta.gravity),
        "exposure": read_optional_field(meta.exposure),
        "camera": read_optional_field(meta.camera) or "",
        "camera_id": read_optional_field(meta.camera_id) or "",
        "T_base_camera": read_optional_field(meta.T_base_camera),
    }
