"""The picture of a moment, drawn on the processor: Gaussians by the project's own rasteriser, the rest over them.

It needs neither a display nor a graphics driver, and it is what the viewer shows where those are missing.
While the person drags, a picture is as fine as keeps up with the hand.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.limits import compute_base_rgb, select_gaussians
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import SHELL, CameraEstimate, GaussianArrays
from splatnode.viewer.shapes import ImageQuad, Label, Lines, Shapes
from splatnode.viewer.state import ViewerState
from splatnode.viewer.viewpoint import (
    BACKGROUND,
    NEAR,
    Canvas,
    FloatArray,
    Image,
    Viewpoint,
    empty_canvas,
    transform_to_camera,
)

# Gaussians painted as points: squares of one size at their centres, the nearest on top.


def paint_points(
    gaussians: GaussianArrays, T_camera_world: FloatArray, K: FloatArray, size: int, width: int, height: int
) -> Canvas:
    """A canvas with squares of `size` pixels at the centres of the Gaussians."""
    points = transform_to_camera(gaussians.means, T_camera_world.astype(np.float32))
    ahead = np.flatnonzero(points[:, 2] > NEAR)
    z = points[ahead, 2]
    focal, corner = K[[0, 1], [0, 1]].astype(np.float32), (K[:2, 2] - size / 2 + 0.5).astype(np.float32)
    columns, rows = np.floor(points[ahead, :2] / z[:, None] * focal + corner).T
    seen = np.flatnonzero((columns > -size) & (columns < width) & (rows > -size) & (rows < height))
    order = seen[np.argsort(-z[seen])]
    columns, rows = columns[order].astype(np.intp), rows[order].astype(np.intp)
    # A frame around the picture takes what sticks out of it. The nearest owns a pixel: it has the largest number, and
    # the last assignment stays. Dilation makes squares of them (float32 holds whole numbers up to 2^24).
    wide = np.zeros((height + 2 * size, width + 2 * size), np.float32)
    wide[rows + size, columns + size] = np.arange(1, len(order) + 1, dtype=np.float32)
    squares = cv2.dilate(wide, np.ones((size, size), np.uint8), anchor=(size - 1, size - 1))
    owner = squares[size : size + height, size : size + width].astype(np.intp)  # 0, where nobody owns a pixel
    colours = np.zeros((len(order) + 1, 4), np.uint8)  # four bytes are one number, which is gathered at once
    colours[0, :3], colours[1:, :3] = BACKGROUND, compute_base_rgb(gaussians)[ahead[order]]
    depths = np.concatenate([np.array([np.inf], np.float32), z[order]])
    # Every owner is a valid index; "clip" spares take the buffer that its check would need.
    four = colours.view(np.uint32)[:, 0].take(owner, mode="clip")[..., None].view(np.uint8)
    return Canvas(np.asarray(cv2.cvtColor(four, cv2.COLOR_RGBA2RGB), np.uint8), depths.take(owner, mode="clip"))


# Photographs and lines painted among the Gaussians: what something hides is left out or dim.

_BEHIND = 1.02  # a shape this many times as far as the surface is behind it
_PIECES = 24  # that a line is cut into, each of them hidden or not
_LETTERS = 0.5  # of OpenCV's size: 11 pixels high
_HIDDEN = 0.3  # how much of a line's colour is left where it is behind something


def paint_shapes(canvas: Canvas, shapes: Shapes, T_camera_world: FloatArray, K: FloatArray) -> None:
    """The photographs, the nearest on top, and over them the lines."""
    in_front = [
        (transform_to_camera(photograph.corners, T_camera_world), photograph) for photograph in shapes.photographs
    ]
    for corners, photograph in sorted(in_front, key=lambda one: -float(one[0][:, 2].mean())):
        _paint_image(canvas, photograph, corners, K)
    _paint_lines(canvas, shapes.lines, T_camera_world, K)
    for label in shapes.labels:
        _paint_label(canvas, label, T_camera_world, K)


def _paint_image(canvas: Canvas, photograph: ImageQuad, corners: FloatArray, K: FloatArray) -> None:
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
    corners: FloatArray, K: FloatArray, low: npt.NDArray[np.int_], size: tuple[int, int]
) -> npt.NDArray[np.float32]:
    """(h, w) 1 / z, at the pixels of the box, of the plane through `corners` (camera frame): affine in the pixel."""
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    height = corners[0] @ normal  # over the eye; 0 where the plane is seen edge-on, and then it covers no pixel
    columns = (low[0] + np.arange(size[0]) + 0.5 - K[0, 2]) / K[0, 0]
    rows = (low[1] + np.arange(size[1]) + 0.5 - K[1, 2]) / K[1, 1]
    sums = (rows * normal[1] + normal[2])[:, None] + (columns * normal[0])[None]
    return (sums / (height if abs(height) > 1e-12 else np.inf)).astype(np.float32)


def _paint_lines(canvas: Canvas, groups: Sequence[Lines], T_camera_world: FloatArray, K: FloatArray) -> None:
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


def _paint_label(canvas: Canvas, label: Label, T_camera_world: FloatArray, K: FloatArray) -> None:
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


def _find_visible_segments(
    pixels: FloatArray, chosen: npt.NDArray[np.bool_]
) -> tuple[FloatArray, npt.NDArray[np.intp]]:
    """(R, 2, 2) ends of the parts of M lines (M, pieces + 1, 2) whose pieces are all `chosen`, (R,) of which line."""
    edges = np.diff(np.pad(chosen, ((0, 0), (1, 1))).astype(np.int8), axis=1)  # a line is straight in the picture too
    return np.stack([pixels[edges > 0], pixels[edges < 0]], 1), np.nonzero(edges > 0)[0]


# A scene seen from outside of its far shell, which would hide all that it surrounds: it is not drawn then.


def cull_far_shell(gaussians: GaussianArrays, eye: npt.NDArray[np.floating]) -> GaussianArrays:
    """Those that a viewer at `eye` (3,) is to see: all, or where it is outside of the far shell, all but that.

    Of a file that does not tell which these are, all.
    """
    shell = gaussians.source_frame == SHELL
    if not shell.any() or shell.all():
        return gaussians
    centre, radius = _fit_sphere(gaussians.means[shell].astype(np.float64))
    inside = float(np.linalg.norm(np.asarray(eye, np.float64) - centre)) < radius
    return gaussians if inside else select_gaussians(gaussians, ~shell)


def _fit_sphere(points: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], float]:
    """Centre (3,) and radius of the sphere on which the points (N, 3) lie, by least squares.

    |p|^2 = 2 c.p + (r^2 - |c|^2) is linear in the centre c and in what is left.
    """
    middle = points.mean(0)
    there = points - middle
    unknowns = np.column_stack([2.0 * there, np.ones(len(there))])
    solution = np.linalg.lstsq(unknowns, (there * there).sum(1), rcond=None)[0]
    centre = solution[:3]
    return centre + middle, float(np.sqrt(max(solution[3] + centre @ centre, 0.0)))


_LETTER = 8  # pixels, the width of a wide letter of a caption


def paint(
    gaussians: GaussianArrays, shapes: Shapes, view: Viewpoint, state: ViewerState, width: int, height: int
) -> Image:
    """(H, W, 3) RGB of the Gaussians, in the colours that they have, with the shapes among them."""
    K = view.K(width, height)
    return overlay_shapes(paint_gaussians(gaussians, view.T_world_camera, K, state, width, height), shapes, view)


def overlay_shapes(canvas: Canvas, shapes: Shapes, view: Viewpoint) -> Image:
    """(H, W, 3) RGB of what is on the canvas, with the shapes among it. The canvas stays as it is."""
    height, width = canvas.depth.shape
    copy = Canvas(canvas.image.copy(), canvas.depth.copy())
    paint_shapes(copy, shapes, np.linalg.inv(view.T_world_camera), view.K(width, height))
    return copy.image


def paint_gaussians(
    gaussians: GaussianArrays, T_world_camera: FloatArray, K: FloatArray, state: ViewerState, width: int, height: int
) -> Canvas:
    """The Gaussians on the background, as Gaussians or as points, or only the background."""
    if not state.gaussians or not len(gaussians):
        return empty_canvas(width, height)
    gaussians = cull_far_shell(gaussians, T_world_camera[:3, 3])
    if state.as_points:
        return paint_points(gaussians, np.linalg.inv(T_world_camera), K, state.point_size, width, height)
    rendered = render_arrays(
        gaussians, T_world_camera.astype(np.float64), K.astype(np.float64), width, height, channels=("rgb", "depth")
    )
    planes = [  # 255 * rgb + (1 - alpha) * background, rounded and clipped
        cv2.addWeighted(rendered.rgb[..., channel], 255.0, rendered.alpha, -level, level, dtype=cv2.CV_8U)
        for channel, level in enumerate(BACKGROUND)
    ]
    np.copyto(rendered.depth, np.inf, where=rendered.alpha <= 0.5)
    return Canvas(np.asarray(cv2.merge(planes), np.uint8), rendered.depth)


def paint_coarsely(
    gaussians: GaussianArrays, view: Viewpoint, state: ViewerState, size: tuple[int, int], part: int
) -> Canvas:
    """The Gaussians for a picture of this size (width, height), painted with one `part`-th of it and made larger."""
    width, height = size
    small = -(-width // part), -(-height // part)
    K = np.diag([small[0] / width, small[1] / height, 1.0]) @ view.K(width, height)
    points = max(1, round(state.point_size / part))
    canvas = paint_gaussians(gaussians, view.T_world_camera, K, replace(state, point_size=points), *small)
    if part == 1:
        return canvas
    image = np.asarray(cv2.resize(canvas.image, size, interpolation=cv2.INTER_LINEAR), np.uint8)
    depth = np.asarray(cv2.resize(canvas.depth, size, interpolation=cv2.INTER_NEAREST), np.float32)
    return Canvas(image, depth)


def blend_image(image: Image, photograph: Image, camera: CameraEstimate, K: FloatArray, weight: float) -> Image:
    """`image` with the camera's photograph over it, where both are seen from the camera and `K` is the window's."""
    height, width = image.shape[:2]
    size = np.array([camera.width / photograph.shape[1], camera.height / photograph.shape[0], 1.0])
    homography = K @ np.linalg.inv(camera.K) @ np.diag(size)
    corner = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # OpenCV's top-left pixel has its centre at (0, 0)
    homography = np.linalg.inv(corner) @ homography @ corner
    over = cv2.warpPerspective(photograph, homography, (width, height), borderMode=cv2.BORDER_REPLICATE)
    inside = cv2.warpPerspective(np.full(photograph.shape[:2], 255, np.uint8), homography, (width, height))
    share = (weight / 255.0 * inside).astype(np.float32)
    return np.asarray(cv2.blendLinear(over, image, share, 1.0 - share), np.uint8)


def add_caption(image: Image, lines: Sequence[str]) -> Image:
    """The image with text on a dark band below it, wrapped; signs that OpenCV's font lacks become plain ones."""
    step, letters = 18, max((image.shape[1] - 16) // _LETTER, 10)
    plain = [line.replace("°", " deg").replace("×", "x").encode("ascii", "replace").decode() for line in lines]
    wrapped = [part for line in plain for part in textwrap.wrap(line, letters)]
    band = np.full((step * len(wrapped) + 10, image.shape[1], 3), BACKGROUND, np.uint8)
    for row, line in enumerate(wrapped):
        origin = (8, step * (row + 1) - 2)
        cv2.putText(band, line, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (225, 225, 225), 1, cv2.LINE_AA)
    return np.vstack([image, band])


# How coarse a picture is painted while the person drags.

SLOWEST_S = (
    0.05  # a picture while dragging may take: twice that, with what else a window does, are 10 pictures a second
)
_COARSEST = 4


def choose_first_divisor(seconds: float) -> int:
    """Returns the divisor of width and height with which a picture of `seconds` in full takes SLOWEST_S at most."""
    return min(max(math.ceil(math.sqrt(seconds / SLOWEST_S) - 0.1), 1), _COARSEST)


def choose_next_divisor(part: int, seconds: float) -> int:
    """The divisor after a picture with this one took `seconds`: coarser where it was late, finer where time is left."""
    if seconds > SLOWEST_S:
        return min(part + 1, _COARSEST)
    finer = max(part - 1, 1)
    return finer if seconds * (part / finer) ** 2 < 0.8 * SLOWEST_S else part
