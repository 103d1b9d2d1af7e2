"""Depth maps that agree with each other: what several views see alike is kept, the rest is left out."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.core import library
from recon.priors.patchmatch import Level, Planes, Transfer, pointer, transfer

Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Config:
    max_error: float = 2.0  # forward-backward reprojection error of agreeing views, pixels
    max_relative_difference: float = 0.01  # of the depth of agreeing views
    min_consistent: int = 1  # other views that must agree


@dataclass(frozen=True, eq=False)
class DepthMap:
    """What stereo knows of a view."""

    depth: Float32  # (h, w) z in the camera frame, 0 where unknown
    normal: Float32  # (h, w, 3) camera frame, unit length, facing the camera, 0 where unknown
    confidence: Float32  # (h, w) about the probability that the depth is within 1 %, 0 where unknown
    num_consistent: npt.NDArray[np.uint8]  # (h, w) how many other views agree


class _Other(ctypes.Structure):
    _fields_ = (
        ("planes", ctypes.c_void_p),
        ("width", ctypes.c_int32),
        ("height", ctypes.c_int32),
        ("from_reference", Transfer),
        ("to_reference", Transfer),
        ("centre", ctypes.c_float * 3),
    )


@dataclass(frozen=True, eq=False)
class Agreement:
    """What the other views say about each pixel of a view."""

    inverse_depth: Float32  # (h, w) mean over the pixel and the views that agree with it
    relative_spread: Float32  # (h, w) root mean square relative difference of depth of the views that agree
    angle: Float32  # (h, w) largest triangulation angle with a view that agrees, radians
    num_consistent: npt.NDArray[np.uint8]  # (h, w) views that agree
    num_inside: npt.NDArray[np.uint8]  # (h, w) views whose image the point falls into
    num_conflicting: npt.NDArray[np.uint8]  # (h, w) views that see something behind the point


class _Agreement(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_void_p) for name in Agreement.__dataclass_fields__)


def cross_check(views: Sequence[Level], planes: Sequence[Planes], config: Config) -> list[DepthMap]:
    """The depth maps of all views, each compared with all others."""
    return [
        depth_map(
            view,
            planes[index],
            agreement(view, planes[index], [*views[:index], *views[index + 1 :]],
                      [*planes[:index], *planes[index + 1 :]], config),
            config,
        )
        for index, view in enumerate(views)
    ]  # fmt: skip


def agreement(
    view: Level, planes: Planes, others: Sequence[Level], other_planes: Sequence[Planes], config: Config
) -> Agreement:
    """What `others` say about the planes of `view`."""
    T_camera_world = np.linalg.inv(view.T_world_camera)
    values = [np.ascontiguousarray(p.values, np.float32) for p in (planes, *other_planes)]
    array = (_Other * len(others))(
        *(
            _Other(
                pointer(value), other.shape[1], other.shape[0], transfer(view, other), transfer(other, view),
                (ctypes.c_float * 3)(*(T_camera_world @ other.T_world_camera)[:3, 3]),
            )
            for other, value in zip(others, values[1:], strict=True)
        )
    )  # fmt: skip
    result = Agreement(
        inverse_depth=np.empty(view.shape, np.float32),
        relative_spread=np.empty(view.shape, np.float32),
        angle=np.empty(view.shape, np.float32),
        num_consistent=np.empty(view.shape, np.uint8),
        num_inside=np.empty(view.shape, np.uint8),
        num_conflicting=np.empty(view.shape, np.uint8),
    )
    pinhole = (ctypes.c_float * 4)(view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2])
    library().patchmatch_check(
        pointer(values[0]), view.shape[1], view.shape[0], pinhole, array, len(others),
        ctypes.c_float(config.max_error), ctypes.c_float(config.max_relative_difference),
        ctypes.byref(_Agreement(*(pointer(getattr(result, name)) for name in Agreement.__dataclass_fields__))),
    )  # fmt: skip
    return result


def depth_map(view: Level, planes: Planes, agreement: Agreement, config: Config) -> DepthMap:
    """The depth that other views agree with, its normal and its confidence."""
    known = (agreement.num_consistent >= config.min_consistent) & (agreement.inverse_depth > 0)
    depth = np.zeros(view.shape, np.float32)
    np.divide(1.0, agreement.inverse_depth, out=depth, where=known)
    confidence = np.where(known, 1 - 0.5 ** agreement.num_consistent.astype(np.float32), 0)
    return DepthMap(
        depth,
        normals(view, planes) * known[..., None],
        (confidence * (1 - np.clip(planes.costs, 0, 0.99))).astype(np.float32),
        np.where(known, agreement.num_consistent, 0).astype(np.uint8),
    )


def normals(view: Level, planes: Planes) -> Float32:
    """(h, w, 3) unit normals in the camera frame, facing the camera; 0 where the plane is unknown.

    Points with n . X = d have inverse depth n . ray / d, so n / d follows from the gradient of the inverse depth.
    """
    height, width = view.shape
    w, du, dv = np.moveaxis(planes.values, -1, 0)
    u, v = np.arange(width, dtype=np.float32) + 0.5, np.arange(height, dtype=np.float32)[:, None] + 0.5
    fx, fy, cx, cy = (np.float32(view.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    towards = -np.stack([fx * du, fy * dv, w - du * (u - cx) - dv * (v - cy)], -1)
    return towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-20)
