"""What is known of a place without the scene that is judged: where its surfaces are, by true cameras or true depth.

Of recorded photographs the depth is that of stereo between ALL of them, those held out of the scene included, with
their true cameras, and only where at least AGREEING other photographs agree. Of the built-in place it is exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.extras.evaluate.dataset import EvaluationScene
from splatnode.extras.evaluate.regions import Surface
from splatnode.recon import priors
from splatnode.recon.geometry import Similarity, transform_to_camera
from splatnode.recon.keyframes import resize_image
from splatnode.recon.priors import Pointmap, stereo

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

AGREEING = 2  # further photographs that see a pixel's depth as well
OFF = 0.1  # of a surface's depth: what is nearer by more stands before it, what is nearer or farther by less is on it
WINDOW_PX = 5  # side of the window in which all known surfaces must lie behind a point
KNOWN_SHARE = 0.6  # of that window whose depth must be known
LONGER_SIDE = 512  # pixels of the photographs that stereo compares
RANGE_MARGIN = 4.0  # times what registration's points reach, nearer and farther, is searched


@dataclass(frozen=True, eq=False)
class KnownView(Surface):
    """A true camera and the depths that it is sure of; 0 where nobody is."""

    def moved(self, to: Similarity) -> KnownView:
        """The same in another world."""
        return replace(self, T_world_camera=to.camera(self.T_world_camera), depth=self.depth * np.float32(to.scale))


@dataclass(frozen=True, eq=False)
class KnownSurfaces:
    """All true cameras of a place, by name, and what they are sure of."""

    views: dict[str, KnownView]

    def moved(self, to: Similarity) -> KnownSurfaces:
        return KnownSurfaces({name: view.moved(to) for name, view in self.views.items()})

    def crossed(self, points: Array) -> tuple[Mask, Mask]:
        """(M,) which of the points (M, 3) a camera looks through, and (M,) which are on what one sees."""
        through, on = np.zeros(len(points), bool), np.zeros(len(points), bool)
        for view in self.views.values():
            looks_through, ends = lines_of_sight(view, points)
            through |= looks_through
            on |= ends
        return through, on

    def seen_from(self, T_world_camera: Array, K: Array, width: int, height: int) -> KnownView:
        """What is known of the surfaces that a further camera would see: the nearest of all points in each pixel."""
        nothing = np.zeros((height, width), np.float32)
        target = _pointmap(KnownView(T_world_camera, K, nothing))
        nearest = np.full((height, width), np.inf, np.float32)
        for view in self.views.values():
            nearest = np.minimum(nearest, priors.project_nearest(_pointmap(view), target)[0])
        return KnownView(T_world_camera, K, np.where(np.isfinite(nearest), nearest, 0).astype(np.float32))


def _pointmap(view: KnownView) -> Pointmap:
    return Pointmap("", 0, view.depth, view.depth, np.zeros((1, 1, 3), np.float32), view.T_world_camera, view.K)


def lines_of_sight(view: KnownView, points: Array) -> tuple[Mask, Mask]:
    """(M,) which points (M, 3) the camera looks through, and (M,) which are on what it sees."""
    known = view.depth > 0
    window = np.ones((WINDOW_PX, WINDOW_PX), np.uint8)
    nearest = cv2.erode(np.where(known, view.depth, np.float32(np.inf)).astype(np.float32), window)
    share = cv2.blur(known.astype(np.float32), (WINDOW_PX, WINDOW_PX))
    inside, row, column, z = view.pixels(points)
    sure = inside & known[row, column]
    through = sure & (share[row, column] >= KNOWN_SHARE) & (z < (1 - OFF) * nearest[row, column])
    on = sure & (np.abs(z - view.depth[row, column]) <= OFF * view.depth[row, column])
    return through, on


def of_photographs(scene: EvaluationScene, points: Array, to_true: Similarity) -> KnownSurfaces:
    """The surfaces of a recorded place in its true world.

    `points` (M, 3), of a registration, tell only how far stereo has to search; `to_true` carries them there.
    """
    images = {name: resize_image(scene.image(name), LONGER_SIDE) for name in scene.cameras}
    world = to_true(points)
    views = []
    for name, image in images.items():
        camera = scene.cameras[name]
        z = transform_to_camera(world, camera.T_world_camera)[:, 2]
        height, width = image.shape[:2]
        near_far = stereo.estimate_depth_range(z, RANGE_MARGIN)
        views.append(stereo.StereoView(image, camera.K_for(width, height), camera.T_world_camera, near_far))
    maps = stereo.estimate_depth_maps(views, stereo.StereoConfig())
    return KnownSurfaces(
        {
            name: KnownView(view.T_world_camera, view.K, np.where(each.num_consistent >= AGREEING, each.depth, 0))
            for name, view, each in zip(images, views, maps, strict=True)
        }
    )


def of_built_in(config: synthetic.Config) -> KnownSurfaces:
    """The surfaces of the built-in place, as its photographs and those held out see them."""
    taken = [(synthetic.frame_name(i), camera) for i, camera in enumerate(synthetic.scene_cameras(config))]
    between = [(f"between_{i:03d}", camera) for i, camera in enumerate(synthetic.evaluation_cameras(config))]
    return KnownSurfaces(
        {
            name: KnownView(camera[0], camera[1], _finite(synthetic.depth_map(config, camera)))
            for name, camera in (*taken, *between)
        }
    )


def _finite(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)
