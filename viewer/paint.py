"""The picture of a moment, drawn on the processor: Gaussians by the project's own rasteriser, the rest over them.

It needs neither a display nor a graphics driver, and it is what the viewer shows where those are missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from recon.export.prepare import base_rgb
from recon.picture import take_picture
from recon.snapshot import CameraEstimate, GaussianArrays
from viewer.shapes import Lines, Photograph, Shapes
from viewer.state import State
from viewer.viewpoint import Viewpoint

Array = npt.NDArray[np.floating]
Image = npt.NDArray[np.uint8]  # (H, W, 3) RGB

BACKGROUND = (24, 26, 30)
_NEAR = 0.005  # world units: nothing closer is drawn
_BEHIND = 1.02  # a shape this many times as far as the surface is behind it
_PIECES = 24  # that a line is cut into, each of them hidden or not
_HIDDEN = 0.3  # how much of a line's colour is left where it is behind something


@dataclass(frozen=True, eq=False)
class Canvas:
    image: Image
    depth: npt.NDArray[np.float32]  # (H, W) z of what is there, infinite where there is nothing


def paint(gaussians: GaussianArrays, shapes: Shapes, view: Viewpoint, state: State, width: int, height: int) -> Image:
    """(H, W, 3) RGB of the Gaussians, in the colours that they have, with the shapes among them."""
    K = view.K(width, height)
    canvas = paint_gaussians(gaussians, view.T_world_camera, K, state, width, height)
    T_camera_world = np.linalg.inv(view.T_world_camera)
    farthest_first = sorted(
        shapes.photographs, key=lambda photograph: -float(_local(photograph.corners, T_camera_world)[:, 2].mean())
    )
    for photograph in farthest_first:
        _paint_photograph(canvas, photograph, T_camera_world, K)
    for lines in shapes.lines:
        _paint_lines(canvas, lines, T_camera_world, K)
    return canvas.image


def paint_gaussians(
    gaussians: GaussianArrays, T_world_camera: Array, K: Array, state: State, width: int, height: int
) -> Canvas:
    """The Gaussians on the background, as Gaussians or as points, or only the background."""
    background = np.full((height, width, 3), BACKGROUND, np.uint8)
    nothing = np.full((height, width), np.inf, np.float32)
    if not state.gaussians or not len(gaussians):
        return Canvas(background, nothing)
    if state.as_points:
        canvas = Canvas(background, nothing)
        _paint_points(canvas, gaussians, np.linalg.inv(T_world_camera), K, state.point_size)
        return canvas
    picture = take_picture(
        gaussians, T_world_camera.astype(np.float64), K.astype(np.float64), width, height, channels=("rgb", "depth")
    )
    planes = [  # 255 * rgb + (1 - alpha) * background, rounded and clipped
        cv2.addWeighted(picture.rgb[..., channel], 255.0, picture.alpha, -level, level, dtype=cv2.CV_8U)
        for channel, level in enumerate(BACKGROUND)
    ]
    return Canvas(
        np.asarray(cv2.merge(planes), np.uint8), np.where(picture.alpha > 0.5, picture.depth, np.inf).astype(np.float32)
    )


def blended(image: Image, photograph: Image, camera: CameraEstimate, K: Array, weight: float) -> Image:
    """`image` with the camera's photograph over it, where both are seen from the camera and `K` is the window's."""
    height, width = image.shape[:2]
    size = np.array([camera.width / photograph.shape[1], camera.height / photograph.shape[0], 1.0])
    homography = K @ np.linalg.inv(camera.K) @ np.diag(size)
    corner = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # OpenCV's top-left pixel has its centre at (0, 0)
    homography = np.linalg.inv(corner) @ homography @ corner
    over = cv2.warpPerspective(photograph, homography, (width, height), flags=cv2.INTER_LINEAR)
    inside = cv2.warpPerspective(np.full(photograph.shape[:2], 255, np.uint8), homography, (width, height))
    share = (weight / 255.0 * inside)[..., None]
    return np.rint(share * over + (1.0 - share) * image).astype(np.uint8)


def caption(image: Image, lines: Sequence[str]) -> Image:
    """The image with lines of text on a dark band below it; signs that OpenCV's font lacks become plain ones."""
    step = 18
    band = np.full((step * len(lines) + 10, image.shape[1], 3), BACKGROUND, np.uint8)
    for row, line in enumerate(lines):
        plain = line.replace("°", " deg").replace("×", "x").encode("ascii", "replace").decode()
        origin = (8, step * (row + 1) - 2)
        cv2.putText(band, plain, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (225, 225, 225), 1, cv2.LINE_AA)
    return np.vstack([image, band])


def project(points: Array, view: Viewpoint, width: int, height: int) -> Array:
    """(M, 3) pixel x, pixel y and z of world points (M, 3) in the window."""
    local = _local(points, np.linalg.inv(view.T_world_camera))
    z = np.where(np.abs(local[:, 2]) > 1e-9, local[:, 2], 1e-9)
    homogeneous = local @ view.K(width, height).T
    return np.column_stack([homogeneous[:, :2] / z[:, None], local[:, 2]])


def _local(points: Array, T_camera_world: Array) -> Array:
    return points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]


def _paint_points(canvas: Canvas, gaussians: GaussianArrays, T_camera_world: Array, K: Array, size: int) -> None:
    """Squares of `size` pixels at the Gaussians' centres, the nearest on top."""
    height, width = canvas.depth.shape
    points = gaussians.means @ T_camera_world[:3, :3].astype(np.float32).T + T_camera_world[:3, 3].astype(np.float32)
    ahead = np.flatnonzero(points[:, 2] > _NEAR)
    z = points[ahead, 2]
    focal, corner = K[[0, 1], [0, 1]].astype(np.float32), (K[:2, 2] - size / 2 + 0.5).astype(np.float32)
    columns, rows = np.floor(points[ahead, :2] / z[:, None] * focal + corner).T
    seen = (columns > -size) & (columns < width) & (rows > -size) & (rows < height)
    order = np.flatnonzero(seen)[np.argsort(-z[seen], kind="stable")]
    columns, rows, z = columns[order].astype(np.int64), rows[order].astype(np.int64), z[order]
    # A frame around the picture takes what sticks out of it. The nearest owns a pixel: it has the largest number, and
    # the last assignment stays. Dilation makes squares of them (float32 holds whole numbers up to 2^24).
    wide = np.full((height + 2 * size, width + 2 * size), -1, np.float32)
    wide[rows + size, columns + size] = np.arange(len(order), dtype=np.float32)
    squares = cv2.dilate(wide, np.ones((size, size), np.uint8), anchor=(size - 1, size - 1))
    owner = squares[size : size + height, size : size + width].astype(np.int32)
    # -1, where nobody owns a pixel, is the last row: the background.
    colours = np.zeros((len(order) + 1, 4), np.uint8)  # four bytes are one number, which is gathered at once
    colours[:-1, :3], colours[-1, :3] = base_rgb(replace(gaussians, sh=gaussians.sh[ahead[order]])), BACKGROUND
    canvas.image[:] = colours.view(np.uint32)[:, 0].take(owner)[..., None].view(np.uint8)[..., :3]
    canvas.depth[:] = np.append(z, np.float32(np.inf)).take(owner)


def _paint_photograph(canvas: Canvas, photograph: Photograph, T_camera_world: Array, K: Array) -> None:
    """The image on its rectangle, where nothing is in front; one that reaches behind the viewpoint is left out."""
    height, width = canvas.depth.shape
    corners = _local(photograph.corners, T_camera_world)
    if corners[:, 2].min() < _NEAR:
        return
    pixels = (corners / corners[:, 2:]) @ K.T
    low = np.maximum(np.floor(pixels[:, :2].min(0)).astype(int), 0)
    high = np.minimum(np.ceil(pixels[:, :2].max(0)).astype(int), [width, height])
    if (high <= low).any():
        return
    image = _shrunk(photograph.image, high - low)
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


def _shrunk(image: Image, size: npt.NDArray[np.int_]) -> Image:
    """The image area-resampled to about `size` (width, height), so that it does not flicker where it is drawn small."""
    ratio = float(np.max(size / np.array([image.shape[1], image.shape[0]])))
    if ratio > 0.7:
        return image
    smaller = max(1, round(ratio * image.shape[1])), max(1, round(ratio * image.shape[0]))
    return np.asarray(cv2.resize(image, smaller, interpolation=cv2.INTER_AREA), np.uint8)


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


def _paint_lines(canvas: Canvas, lines: Lines, T_camera_world: Array, K: Array) -> None:
    """Lines in short pieces: bright where nothing is in front of them, dim where something is."""
    height, width = canvas.depth.shape
    steps = np.linspace(0.0, 1.0, _PIECES + 1)
    start, end = (_local(lines.ends[:, i], T_camera_world) for i in (0, 1))
    points = start[:, None] + steps[None, :, None] * (end - start)[:, None]  # (M, pieces + 1, 3)
    ahead = points[..., 2] > _NEAR
    pixels = (points / np.where(ahead, points[..., 2], 1.0)[..., None]) @ K.T
    bright = tuple(round(255 * value) for value in lines.colour)
    near_window = (np.abs(pixels[..., :2]) < 4 * max(width, height)).all(-1) & ahead
    middle = (pixels[:, :-1, :2] + pixels[:, 1:, :2]) / 2.0
    z = (points[:, :-1, 2] + points[:, 1:, 2]) / 2.0
    columns = np.clip(middle[..., 0], 0, width - 1).astype(int)
    rows = np.clip(middle[..., 1], 0, height - 1).astype(int)
    hidden = z > _BEHIND * canvas.depth[rows, columns]
    drawable = near_window[:, :-1] & near_window[:, 1:]
    for behind in (True, False):
        dim = tuple(round(_HIDDEN * value + (1 - _HIDDEN) * 60) for value in bright)
        chosen = drawable & (hidden == behind)
        pieces = np.stack([pixels[:, :-1, :2][chosen], pixels[:, 1:, :2][chosen]], 1)
        fixed = np.rint((pieces - 0.5) * 16).astype(np.int32)
        cv2.polylines(
            canvas.image, list(fixed), False, dim if behind else bright, 1 if behind else lines.width, cv2.LINE_AA, 4
        )
