"""The picture of a moment, drawn on the processor: Gaussians by the project's own rasteriser, the rest over them.

It needs neither a display nor a graphics driver, and it is what the viewer shows where those are missing.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.viewer.canvas import BACKGROUND, Array, Canvas, Image, empty_canvas
from splatnode.viewer.outside import cull_far_shell
from splatnode.viewer.overlay import paint_shapes
from splatnode.viewer.points import paint_points
from splatnode.viewer.shapes import Shapes
from splatnode.viewer.state import ViewerState
from splatnode.viewer.viewpoint import Viewpoint

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
    gaussians: GaussianArrays, T_world_camera: Array, K: Array, state: ViewerState, width: int, height: int
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


def blend_image(image: Image, photograph: Image, camera: CameraEstimate, K: Array, weight: float) -> Image:
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
