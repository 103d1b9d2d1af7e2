"""The built-in capture with printed markers in it: photographs whose metres are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from splatnode.capture.aruco import DICTIONARIES
from splatnode.capture.cameras import synthetic
from splatnode.capture.diorama import Camera, Shape, Solid, cast
from splatnode.capture.frame import Frame

_THICK_M = 0.002
_TEXELS = 48  # a bit


@dataclass(frozen=True)
class Marker:
    """A marker that leans or lies in the place."""

    number: int = 0
    side_m: float = 0.1
    centre: tuple[float, float, float] = (1.3, 1.3, 0.95)  # metres; above the front of the table
    towards: tuple[float, float, float] = (1.0, 1.0, 0.6)  # that its face looks
    turn_deg: float = 10.0  # in its plane
    dictionary: str = "4X4_50"


def solid(marker: Marker) -> Solid:
    """A thin board with the marker on its face, and a white border of one bit."""
    definition = cv2.aruco.getPredefinedDictionary(DICTIONARIES[marker.dictionary])
    bits = definition.markerSize + 2
    picture = np.pad(cv2.aruco.generateImageMarker(definition, marker.number, bits), 1, constant_values=255)
    shades = np.where(picture > 0, 225, 30).astype(np.uint8)
    skin = np.repeat(np.kron(shades, np.ones((_TEXELS, _TEXELS), np.uint8))[..., None], 3, axis=2)
    paper = np.full((2, 2, 3), 225, np.uint8)
    normal = np.array(marker.towards) / np.linalg.norm(marker.towards)
    right = np.cross([0.0, 0.0, 1.0], normal)
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([1.0, 0.0, 0.0])
    up = np.cross(normal, right)
    cosine, sine = np.cos(np.radians(marker.turn_deg)), np.sin(np.radians(marker.turn_deg))
    half = marker.side_m * (bits + 2) / bits / 2.0
    axes = np.stack(
        [half * (cosine * right + sine * up), half * (cosine * up - sine * right), _THICK_M / 2 * normal], 1
    )
    return Solid(Shape.BOX, axes, np.array(marker.centre), (paper,) * 5 + (skin,))


def photographs(
    config: synthetic.Config,
    cameras: Sequence[Camera],
    markers: Sequence[Marker],
    first_seed: int = 0,
    alone: bool = False,
) -> list[Frame]:
    """The place with the markers in it as the cameras see it, with sensor noise; named as the built-in capture's.

    `alone`: without the place, which takes seconds to paint; the markers hang in the dark.
    """
    things = (*(() if alone else synthetic.solids(config)), *map(solid, markers))
    scale = np.diag([config.samples, config.samples, 1.0])
    frames = []
    for index, (T_world_camera, K) in enumerate(cameras):
        dense = config.width * config.samples, config.height * config.samples
        colours, _ = cast(things, (T_world_camera, scale @ K), *dense)
        image = cv2.resize(colours, (config.width, config.height), interpolation=cv2.INTER_AREA)
        grain = np.random.default_rng([config.seed, first_seed + index, 7]).normal(scale=config.noise, size=image.shape)
        seen = np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)
        frames.append(Frame(index, synthetic.frame_name(index), index * 500_000_000, seen, intrinsics=None))
    return frames


def true_corners(marker: Marker) -> np.ndarray:
    """(4, 3) of the black square, metres: left upper, right upper, right lower, left lower, as it is printed."""
    board = solid(marker)
    definition = cv2.aruco.getPredefinedDictionary(DICTIONARIES[marker.dictionary])
    share = (definition.markerSize + 2) / (definition.markerSize + 4)
    signs = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    return board.centre + share * signs @ board.axes[:, :2].T + board.axes[:, 2]
