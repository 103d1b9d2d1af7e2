"""A pane of glass in the built-in place: what its photographs show, which is nearly what is behind it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.capture.diorama import Camera, Shape, Solid, cast, colour_pixels, trace, turn
from splatnode.extras.cameras.building import mirror_camera

THROUGH, BACK = 0.9, 0.08  # of the light, that passes the glass, and that it reflects


@dataclass(frozen=True, eq=False)
class Pane:
    """A box whose face along its y axis is towards the cameras."""

    solid: Solid

    @classmethod
    def upright(cls, centre: tuple[float, float, float], width: float, height: float) -> Pane:
        """A centimetre thick, across the diagonal of the room, along which the cameras look."""
        axes = turn(-45.0) * (np.array([width, 0.01, height]) / 2)
        return cls(Solid(Shape.BOX, axes, np.array(centre), (np.zeros((1, 1, 3), np.uint8),) * 6))


def photograph(config: synthetic.Config, camera: Camera, pane: Pane, noise_seed: int) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB as `synthetic.photograph`, through the pane and with what it reflects."""
    T_world_camera, K = camera
    width, height = config.width * config.samples, config.height * config.samples
    dense = T_world_camera, np.diag([config.samples, config.samples, 1.0]) @ K
    solids = synthetic.solids(config)
    colours, z = cast(solids, dense, width, height)
    glass, _ = trace([pane.solid], dense, width, height)
    glass = np.where(glass < z, glass, np.inf)
    virtual = mirror_camera(pane.solid, dense)
    reflected = colour_pixels(solids, virtual, *trace(solids, virtual, width, height, glass + 1e-3))
    mixed = np.where(np.isfinite(glass)[..., None], THROUGH * colours + BACK * reflected, colours)
    image = cv2.resize(mixed, (config.width, config.height), interpolation=cv2.INTER_AREA)
    grain = np.random.default_rng([config.seed, noise_seed]).normal(scale=config.noise, size=image.shape)
    return np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)
