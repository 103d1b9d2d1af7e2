"""Photographs of a calibration board through a known lens: what `splatnode calibrate` is judged by.

Nothing in here is of what is judged: OpenCV draws the board, and rays are followed from the picture to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture import lenses
from splatnode.capture.frame import Intrinsics
from splatnode.extras.calibration.board import Board

Array = npt.NDArray[np.float64]

_PIXELS_PER_MM = 6  # of the drawn board
_INK_MM = 0.2  # by which edges are soft on paper: a sharp one would be seen in steps of the distance between samples
_SAMPLES = 4  # a pixel and direction
_FARTHEST = 1e4  # mm; what is farther off the board's middle is not it, either


@dataclass(frozen=True)
class Conditions:
    """How bad the photographs are."""

    blur_px: float = 0.7  # standard deviation
    noise: float = 2.0  # grey levels, standard deviation
    gradient: float = 0.4  # of the light, from one side to the other
    contrast: tuple[float, float] = (30.0, 215.0)  # grey levels of black and white


class Photographer:
    """A lens before a board. The lens's rays are found once."""

    def __init__(self, board: Board, lens: Intrinsics, conditions: Conditions | None = None) -> None:
        self.board, self.lens, self.conditions = board, lens, conditions or Conditions()
        middles = np.stack(np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5), axis=-1)
        rays = lenses.unproject(middles.reshape(-1, 2), lens).reshape(lens.height, lens.width, 3)
        self._seen = np.isfinite(rays).all(axis=-1)
        self._rays = np.nan_to_num(rays)
        margin = round(board.square_mm / 2)
        size = [round(n * board.square_mm + 2 * margin) * _PIXELS_PER_MM for n in (board.columns, board.rows)]
        self._margin_mm = margin
        drawn = board.charuco.generateImage(size, marginSize=margin * _PIXELS_PER_MM, borderBits=1)
        self._drawn = cv2.GaussianBlur(drawn, (0, 0), _INK_MM * _PIXELS_PER_MM)

    def photograph(self, T_camera_board: Array, seed: int) -> npt.NDArray[np.uint8]:  # (H, W, 3)
        """What the camera sees of the board, in millimetres before a grey wall."""
        conditions, rng = self.conditions, np.random.default_rng(seed)
        height, width = self.lens.height, self.lens.width
        picture = np.full((height, width), 110.0, np.float32)
        _, on_it = self._hit(self._rays, T_camera_board)
        if on_it.any():
            (y0, x0), (y1, x1) = np.argwhere(on_it).min(axis=0), np.argwhere(on_it).max(axis=0) + 1
            y0, x0 = max(0, y0 - 2), max(0, x0 - 2)
            picture[y0 : y1 + 2, x0 : x1 + 2] = self._near(self._rays[y0 : y1 + 2, x0 : x1 + 2], T_camera_board)
        across = np.cos(angle := rng.uniform(0, 2 * np.pi)), np.sin(angle)
        slope = np.add.outer(np.linspace(-0.5, 0.5, height) * across[1], np.linspace(-0.5, 0.5, width) * across[0])
        picture = picture * (1 + conditions.gradient * slope) * self._seen
        picture = cv2.GaussianBlur(picture, (0, 0), conditions.blur_px)
        picture = picture + rng.normal(0, conditions.noise, picture.shape)
        grey = np.clip(np.round(picture), 0, 255).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1)

    def _near(self, rays: Array, T_camera_board: Array) -> npt.NDArray[np.float32]:
        """The light of pixels with rays (h, w, 3), each the mean of several samples."""
        size = rays.shape[1], rays.shape[0]
        many = cv2.resize(rays, (size[0] * _SAMPLES, size[1] * _SAMPLES), interpolation=cv2.INTER_LINEAR)
        at, on_it = self._hit(many, T_camera_board)
        black, white = self.conditions.contrast
        paper = cv2.remap(self._drawn, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        light = np.where(on_it, black + (white - black) * (paper / 255.0), 110.0).astype(np.float32)
        return cv2.resize(light, size, interpolation=cv2.INTER_AREA).astype(np.float32)

    def _hit(self, rays: Array, T_camera_board: Array) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
        """Where rays (h, w, 3) meet the drawn board, pixels of that (h, w, 2), and whether they do."""
        rotation, place = T_camera_board[:3, :3], T_camera_board[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (rotation[:, 2] @ place) / (rays @ rotation[:, 2])
            points = depth[..., None] * (rays @ rotation[:, :2]) - place @ rotation[:, :2]
        points[~(depth > 0)] = _FARTHEST
        at = (np.clip(points, -_FARTHEST, _FARTHEST) + self._margin_mm) * _PIXELS_PER_MM - 0.5
        sides = np.array(self._drawn.shape[::-1])
        return at.astype(np.float32), np.asarray(((at > 0) & (at < sides - 1)).all(axis=-1))


def waved(board: Board, lens: Intrinsics, count: int, seed: int, tilt_deg: float = 45.0) -> list[Array]:
    """Ts_camera_board as of somebody who shows the board everywhere in the picture, tilted by up to `tilt_deg`.

    Every fourth view is at one of the picture's corners.
    """
    rng = np.random.default_rng(seed)
    columns = int(np.ceil(np.sqrt(count * lens.width / lens.height)))
    rows = int(np.ceil(count / columns))
    cells = rng.permutation([((x + 0.5) / columns, (y + 0.5) / rows) for y in range(rows) for x in range(columns)])
    found = []
    for number in range(count):
        if number % 4 == 3:
            inset = rng.uniform(0.05, 0.2, 2)
            place = np.where([number // 4 % 2, number // 8 % 2], 1 - inset, inset)
        else:
            place = 0.5 + (cells[number] - 0.5) * 0.9 + rng.uniform(-0.3, 0.3, 2) / (columns, rows)
        found.append(_shown(board, lens, place, rng, tilt_deg))
    return found


def _shown(board: Board, lens: Intrinsics, place: Array, rng: np.random.Generator, tilt_deg: float) -> Array:
    """The board with its middle at `place` (of the picture's sides), at a distance and a tilt by chance."""
    sides = np.array([lens.width, lens.height], np.float64)
    pixel, middle = place * sides, sides / 2
    ray = lenses.unproject(pixel[None], lens)[0]
    while not np.isfinite(ray).all():
        pixel = middle + 0.9 * (pixel - middle)
        ray = lenses.unproject(pixel[None], lens)[0]
    wide = board.columns * board.square_mm
    distance = wide * lens.fx / (rng.uniform(0.3, 0.55) * lens.width)
    if lens.model == "fisheye":
        distance = max(distance, 0.6 * wide)
    axis_angle = rng.uniform(0, 2 * np.pi)
    tilt = np.radians(rng.uniform(0.2, 1.0) * tilt_deg)
    tilted, _ = cv2.Rodrigues(tilt * np.array([np.cos(axis_angle), np.sin(axis_angle), 0.0]))
    turned, _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-0.5, 0.5)]))
    T = np.eye(4)
    T[:3, :3] = _facing(ray) @ tilted @ turned
    T[:3, 3] = distance * ray - T[:3, :3] @ (np.array([wide, board.rows * board.square_mm, 0.0]) / 2)
    return T


def _facing(ray: Array) -> Array:
    """A rotation whose z axis is `ray`, and whose x axis is as level as it can be."""
    across = np.cross([0.0, 1.0, 0.0], ray)
    across /= np.linalg.norm(across)
    return np.column_stack([across, np.cross(ray, across), ray])


def parallel(board: Board, lens: Intrinsics, count: int, seed: int) -> list[Array]:
    """Ts_camera_board that are everywhere in the picture and never tilted against it."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        T = np.eye(4)
        T[:3, :3], _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-0.5, 0.5)]))
        depth = board.columns * board.square_mm * lens.fx / (rng.uniform(0.4, 0.5) * lens.width)
        ray = lenses.unproject(rng.uniform(0.1, 0.9, (1, 2)) * (lens.width, lens.height), lens)[0]
        middle = T[:3, :3] @ [board.columns * board.square_mm / 2, board.rows * board.square_mm / 2, 0.0]
        T[:3, 3] = depth * ray / ray[2] - middle
        found.append(T)
    return found
