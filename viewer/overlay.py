"""Photographs and lines painted among the Gaussians: what something hides is left out or dim."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.viewer.canvas import NEAR, Array, Canvas, Image, transform_to_camera
from splatnode.viewer.shapes import ImageQuad, Label, Lines, Shapes

_BEHIND = 1.02  # a shape this many times as far as the surface is behind it
_PIECES = 24  # that a line is cut into, each of them hidden or not
_LETTERS = 0.5  # of OpenCV's size: 11 pixels high
_HIDDEN = 0.3  # how much of a line's colour is left where it is behind something


def paint_shapes(canvas: Canvas, shapes: Shapes, T_camera_world: Array, K: Array) -> None:
    """The photographs, the nearest on top, and over them the lines."""
    in_front = [
        (transform_to_camera(photograph.corners, T_camera_world), photograph) for photograph in shapes.photographs
    ]
    for corners, photograph in sorted(in_front, key=lambda one: -float(one[0][:, 2].mean())):
        _paint_image(canvas, photograph, corners, K)
    _paint_lines(canvas, shapes.lines, T_camera_world, K)
    for label in shapes.labels:
        _paint_label(canvas, label, T_camera_world, K)


def _paint_image(canvas: Canvas, photograph: ImageQuad, corners: Array, K: Array) -> None:
    """The image on its rectangle (camera frame), where nothing is in front; not if that reaches behind the eye."""
    height, width = canvas.depth.shape
    if corners[:, 2].min() < NEAR:
        return
    pixels = (corners / corners[:, 2:]) @ K.T
    low = np.maximum(np.floor(pixels[:, :2].min(0)).astype(int), 0)
    high = np.minimum(np.ceil(pixels[:, :2].max(0)).astype(int), [width, height])
    if (high <= low).any():
        return
    image = _select_pyramid_level(photograph.levels, high - low)
    image_height, image_width = image.shape[:2]
    source = np.array([[0, 0], [image_width, 0], [image_width, image_height], [0, image_height]], np.float32) - 0.5
    target = (pixels[:, :2] - low - 0.5).astype(np.float32)
    homography = cv2.getPerspectiveTransform(source, target)
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    warped = cv2.warpPerspective(image, homography, size, flags=cv2.INTER_LINEAR)
    inside = cv2.warpPerspective(np.full((image_height, image_width), 255, np.uint8), homography, size) > 127
    box = np.s_[low[1] : high[1], low[0] : high[0]]
    nearness = _plane_nearness(corners, K, low, size)
    shown = inside & (_BEHIND * canvas.depth[box] * nearness >= 1.0)
    np.copyto(canvas.image[box], warped, where=shown[..., None])
    np.divide(1.0, nearness, out=canvas.depth[box], where=shown)


def _select_pyramid_level(levels: tuple[Image, ...], size: npt.NDArray[np.int_]) -> Image:
    """The smallest of the images that has at least 0.7 pixels for each of `size` (width, height): none flickers."""
    enough = [image for image in levels if (np.array([image.shape[1], image.shape[0]]) >= 0.7 * size).all()]
    return enough[-1] if enough else levels[0]


def _plane_nearness(
    corners: Array, K: Array, low: npt.NDArray[np.int_], size: tuple[int, int]
) -> npt.NDArray[np.float32]:
    """(h, w) 1 / z, at the pixels of the box, of the plane through `corners` (camera frame): affine in the pixel."""
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    height = corners[0] @ normal  # over the eye; 0 where the plane is seen edge-on, and then it covers no pixel
    columns = (low[0] + np.arange(size[0]) + 0.5 - K[0, 2]) / K[0, 0]
    rows = (low[1] + np.arange(size[1]) + 0.5 - K[1, 2]) / K[1, 1]
    sums = (rows * normal[1] + normal[2])[:, None] + (columns * normal[0])[None]
    return (sums / (height if abs(height) > 1e-12 else np.inf)).astype(np.float32)


def _paint_lines(canvas: Canvas, groups: Sequence[Lines], T_camera_world: Array, K: Array) -> None:
    """Lines, bright where nothing is in front of them, dim where something is. All at once: there are many groups."""
    if not groups:
        return
    height, width = canvas.depth.shape
    ends = np.concatenate([group.ends for group in groups])
    group_of = [number for number, group in enumerate(groups) for _ in group.ends]
    steps = np.linspace(0.0, 1.0, _PIECES + 1)
    start, end = (transform_to_camera(ends[:, i], T_camera_world) for i in (0, 1))
    points = start[:, None] + steps[None, :, None] * (end - start)[:, None]  # (M, pieces + 1, 3)
    ahead = points[..., 2] > NEAR
    pixels = ((points / np.where(ahead, points[..., 2], 1.0)[..., None]) @ K.T)[..., :2]
    near_window = (np.abs(pixels) < 4 * max(width, height)).all(-1) & ahead
    columns, rows = ((pixels[:, :-1] + pixels[:, 1:]) / 2.0).transpose(2, 0, 1)
    surface = canvas.depth[np.clip(rows, 0, height - 1).astype(int), np.clip(columns, 0, width - 1).astype(int)]
    hidden = (points[:, :-1, 2] + points[:, 1:, 2]) / 2.0 > _BEHIND * surface
    drawable = near_window[:, :-1] & near_window[:, 1:]
    bright = [tuple(round(255 * value) for value in group.colour) for group in groups]
    for chosen, behind in ((drawable & hidden, True), (drawable & ~hidden, False)):
        pieces, line_of = _find_visible_segments(pixels, chosen)
        for piece, line in zip(np.rint((pieces - 0.5) * 16).astype(np.int32).tolist(), line_of, strict=True):
            colour, thick = bright[group_of[line]], groups[group_of[line]].width
            if behind:
                colour, thick = tuple(round(_HIDDEN * value + (1 - _HIDDEN) * 60) for value in colour), 1
            cv2.line(canvas.image, piece[0], piece[1], colour, thick, cv2.LINE_AA, 4)


def _paint_label(canvas: Canvas, label: Label, T_camera_world: Array, K: Array) -> None:
    """The letters on a dark plate, over everything else; not of a point that is behind the eye or far off."""
    at = transform_to_camera(label.at, T_camera_world)
    height, width = canvas.depth.shape
    if at[2] < NEAR:
        return
    pixel = (K @ (at / at[2]))[:2]
    if not (np.abs(pixel) < 2 * max(width, height)).all():
        return
    column, row = round(float(pixel[0])), round(float(pixel[1]))
    (wide, high), _ = cv2.getTextSize(label.text, cv2.FONT_HERSHEY_SIMPLEX, _LETTERS, 1)
    plate = canvas.image[max(row - high - 5, 0) : max(row + 6, 0), max(column - 5, 0) : max(column + wide + 5, 0)]
    plate[:] = plate // 3
    colour = tuple(round(255 * value) for value in label.colour)
    place = column, row
    cv2.putText(canvas.image, label.text, place, cv2.FONT_HERSHEY_SIMPLEX, _LETTERS, colour, 1, cv2.LINE_AA)


def _find_visible_segments(pixels: Array, chosen: npt.NDArray[np.bool_]) -> tuple[Array, npt.NDArray[np.intp]]:
    """(R, 2, 2) ends of the parts of M lines (M, pieces + 1, 2) whose pieces are all `chosen`, (R,) of which line."""
    edges = np.diff(np.pad(chosen, ((0, 0), (1, 1))).astype(np.int8), axis=1)  # a line is straight in the picture too
    return np.stack([pixels[edges > 0], pixels[edges < 0]], 1), np.nonzero(edges > 0)[0]
