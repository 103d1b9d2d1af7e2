"""What another lens, another way to hold the camera, or another camera would have seen: photographs with new cameras.

Pixels are sampled from the photograph, so each function says what it takes from outside of it: nothing, or grey.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Intrinsics
from splatnode.extras.evaluate.dataset import (
    EvaluationScene,
    TrueCamera,
    check_distinct_names,
    load_scene,
    write_capture,
)
from splatnode.recon.geometry import angles_deg, distortion

# Where the photographs of the trials come from: recorded scenes with true cameras, or the built-in place.

T = TypeVar("T")
Image = npt.NDArray[np.uint8]
Poses = npt.NDArray[np.float64]  # (M, 4, 4) T_world_camera

USUAL_STEP_DEG = 12.0  # of rotation between neighbours of a set, as people take photographs
MAX_STEP_DEG = 20.0  # beyond, photographs may share too little: a refusal would be no mistake
MIN_SPAN_DEG = 8.0  # below, a set's views are as good as parallel: its focal length trades against its depth
_LONGEST_STRIDE = 4  # photographs of the capture between two neighbours of a set, at most
_USUAL_STEP_RANGE = 0.5, 5.0  # of the median step: shorter ones are pauses, longer ones are gaps in the capture
_MIN_PHOTOGRAPHS = 6  # of a recorded scene; with fewer, few rows find a set in it

_BUILT_IN_SEEDS = (0, 1, 2, 3)
_BUILT_IN_VIEWS = 12
_STILL_REL = 1e-6  # of the largest coordinate: centres this close together are one
_MIN_SHARE_ALONG_VIEW = 0.9  # share of the motion that is along the view


@dataclass(frozen=True, eq=False)
class TrialImage:
    """A photograph as a row changes it, with the camera that is true of what it then shows."""

    name: str
    image: Image  # (H, W, 3) RGB
    camera: TrueCamera | None  # of `image`; None: it belongs nowhere
    place: str = ""  # that it shows, for people
    intrinsics: Intrinsics | None = None  # what the reconstruction is told


@dataclass(frozen=True, eq=False)
class TrialScene:
    """A scene whose photographs `names`, in the order of capture, have true cameras."""

    scene: EvaluationScene
    names: tuple[str, ...]

    @property
    def name(self) -> str:
        return self.scene.name

    @property
    def Ts_world_camera(self) -> Poses:
        return np.stack([self.scene.cameras[name].T_world_camera for name in self.names])

    def load_image(self, index: int) -> TrialImage:
        name = self.names[index]
        return TrialImage(name, self.scene.image(name), self.scene.cameras[name], self.name)

    def load_images(self, indices: Sequence[int]) -> list[TrialImage]:
        return [self.load_image(index) for index in indices]


@dataclass(frozen=True, eq=False)
class ScenesByMotion:
    """`walked`: the camera moved to the side; `forward`: mostly along its view; `turned`: it stood on the spot."""

    walked: tuple[TrialScene, ...]
    forward: tuple[TrialScene, ...] = ()
    turned: tuple[TrialScene, ...] = ()


@dataclass(frozen=True, eq=False)
class Sampler:
    """Draws photographs for a row. Seeds take turns through the places, so that a row sees as many as it can."""

    places: ScenesByMotion
    row_name: str
    seed: int

    @property
    def rng(self) -> np.random.Generator:
        """Fresh at every call, the same for the same row and seed."""
        return np.random.default_rng([self.seed, zlib.crc32(self.row_name.encode())])

    def list_scenes_in_turn(self) -> list[TrialScene]:
        """All places in which the camera moved to the side, that of this seed first."""
        return _rotate_list(self.places.walked, self._turn)

    def choose_window(
        self, count: int, apart_from: Sequence[TrialImage] = (), step_deg: float = USUAL_STEP_DEG
    ) -> tuple[TrialScene, list[int]]:
        """A place that none of the photographs `apart_from` shows, and positions of `count` that overlap well there.

        They are neighbours as far apart as `step_deg` allows, so that the camera has moved; where none are as close,
        neighbours within `MAX_STEP_DEG`. Raises ValueError where no place has as many.
        """
        shown = {photo.place for photo in apart_from}
        places = [place for place in self.places.walked if place.name not in shown]
        found = [(place, *find_neighbour_sets(place.Ts_world_camera, count, step_deg)) for place in places]
        fitting = [(place, starts, stride) for place, starts, stride in found if starts]
        if not fitting:
            raise ValueError(
                f"row {self.row_name!r} needs a place with {count} photographs that follow each other at "
                f"{MAX_STEP_DEG:g} degrees or less, and turn {MIN_SPAN_DEG:g} degrees in all; give more scenes"
            )
        place, starts, stride = _rotate_list(fitting, self._turn)[0]
        start = int(self.rng.choice(starts))
        return place, [start + stride * i for i in range(count)]

    def load_images(
        self, count: int, apart_from: Sequence[TrialImage] = (), step_deg: float = USUAL_STEP_DEG
    ) -> list[TrialImage]:
        """The photographs of `choose_window`."""
        place, indices = self.choose_window(count, apart_from, step_deg)
        return place.load_images(indices)

    def load_one_per_scene(self, most: int) -> list[TrialImage]:
        """One photograph each of at most `most` places, under names of their own."""
        chosen: list[TrialImage] = []
        for number in range(min(most, len(self.places.walked))):
            chosen += rename_images(self.load_images(1, chosen), str(number))
        return chosen

    @property
    def _turn(self) -> int:
        return self.seed + zlib.crc32(self.row_name.encode())


def _rotate_list(items: Sequence[T], turn: int) -> list[T]:
    """`items` from the one whose turn it is, round to the one before it."""
    first = turn % len(items)
    return [*items[first:], *items[:first]]


def find_neighbour_sets(Ts_world_camera: Poses, count: int, step_deg: float) -> tuple[list[int], int]:
    """Finds where sets of `count` cameras may start, and the longest stride that keeps to `step_deg`."""
    starts, stride = _find_strided_sets(Ts_world_camera, count, _LONGEST_STRIDE, partial(_is_overlapping, step_deg))
    return (
        (starts, stride)
        if starts
        else _find_strided_sets(Ts_world_camera, count, 1, partial(_is_overlapping, MAX_STEP_DEG))
    )


def find_parallel_sets(Ts_world_camera: Poses, count: int) -> tuple[list[int], int]:
    """The same for cameras that look in one direction, by which a focal length can hardly be told."""
    return _find_strided_sets(
        Ts_world_camera, count, _LONGEST_STRIDE, lambda chosen: _compute_span_deg(chosen) < MIN_SPAN_DEG
    )


def _find_strided_sets(
    everyone: Poses, count: int, longest: int, fits: Callable[[Poses], bool]
) -> tuple[list[int], int]:
    """The starts of sets of `count` cameras that fit and whose steps are usual, at the longest stride that has any."""
    median = float(np.median(_compute_steps(everyone)))
    least, most = (factor * median for factor in _USUAL_STEP_RANGE)
    for stride in range(longest, 0, -1):
        starts = []
        for start in range(len(everyone) - stride * (count - 1)):
            chosen = everyone[start : start + stride * count : stride]
            steps = _compute_steps(chosen)
            if (steps >= least).all() and (steps <= most).all() and fits(chosen):
                starts.append(start)
        if starts:
            return starts, stride
    return [], 1


def _is_overlapping(limit_deg: float, chosen: Poses) -> bool:
    """Whether each camera sees what the next one sees, and three or more turn enough to tell their focal length."""
    turns = angles_deg(chosen[:-1, :3, :3], chosen[1:, :3, :3])
    return bool((turns <= limit_deg).all()) and (len(chosen) < 3 or _compute_span_deg(chosen) >= MIN_SPAN_DEG)


def _compute_span_deg(chosen: Poses) -> float:
    """The largest angle between the views of any two cameras."""
    axes = chosen[:, :3, 2]
    return float(np.degrees(np.arccos(np.clip((axes @ axes.T).min(), -1.0, 1.0))))


def _compute_steps(chosen: Poses) -> npt.NDArray[np.float64]:
    return np.linalg.norm(np.diff(chosen[:, :3, 3], axis=0), axis=1)


def rename_images(photos: Sequence[TrialImage], mark: str) -> list[TrialImage]:
    """The photographs under names of their own, for sets in which a name would occur twice."""
    return [replace(photo, name=f"{mark}_{photo.name}") for photo in photos]


def load_scenes_by_motion(scenes: Sequence[Path], out: Path) -> ScenesByMotion:
    """The scenes in their folders, sorted by how their camera moved; without any, the built-in place in `out`/places.

    Raises ValueError where fewer than three scenes have a camera that moved to the side: there would be no mixtures.
    """
    loaded = load_trial_scenes(scenes, out)
    kinds = {"walked": [], "forward": [], "turned": []}
    for place in loaded:
        kinds[classify_motion(place.Ts_world_camera)].append(place)
    if len(kinds["walked"]) < 3:
        raise ValueError(
            f"at least three scenes must have a camera that moved to the side, {len(kinds['walked'])} of {len(loaded)} "
            "have; give more scenes, or none to use the built-in place"
        )
    return ScenesByMotion(**{kind: tuple(places) for kind, places in kinds.items()})


def load_trial_scenes(scenes: Sequence[Path], out: Path) -> list[TrialScene]:
    """The scenes in their folders; without any, the built-in place in `out`/places.

    Raises ValueError where a scene has too few photographs with true cameras, or two have one name.
    """
    check_distinct_names(scenes)
    return [_load_recorded_scene(folder) for folder in scenes] or [
        load_built_in_scene(out, seed) for seed in _BUILT_IN_SEEDS
    ]


def classify_motion(Ts_world_camera: Poses) -> str:
    """How cameras (M, 4, 4) in the order of capture moved: the name of a field of `ScenesByMotion`."""
    centres = Ts_world_camera[:, :3, 3]
    steps = np.diff(centres, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    if lengths.max(initial=0.0) <= _STILL_REL * (1.0 + float(np.abs(centres).max(initial=0.0))):
        return "turned"
    along = np.abs((steps * Ts_world_camera[:-1, :3, 2]).sum(1))
    return "forward" if along.sum() > _MIN_SHARE_ALONG_VIEW * lengths.sum() else "walked"


def find_distant_views(place: TrialScene, count: int, least_deg: float, rng: np.random.Generator) -> list[int] | None:
    """Positions of `count` photographs whose views differ by `least_deg` each; None where there are not as many."""
    rotations = place.Ts_world_camera[:, :3, :3]
    chosen: list[int] = []
    for index in rng.permutation(len(rotations)):
        if all(angles_deg(rotations[index], rotations[other]) >= least_deg for other in chosen):
            chosen.append(int(index))
    return sorted(chosen[:count]) if len(chosen) >= count else None


def load_built_in_scene(out: Path, seed: int) -> TrialScene:
    """The built-in place, written to `out`/places unless it is there."""
    folder = out / "places" / f"built_in_{seed}"
    config = synthetic.Config(views=_BUILT_IN_VIEWS, seed=seed)
    if not (folder / "cameras.json").exists():
        write_capture(folder, config)
    return TrialScene(load_scene(folder), tuple(synthetic.frame_name(i) for i in range(config.views)))


def _load_recorded_scene(folder: Path) -> TrialScene:
    scene = load_scene(folder)
    names = tuple(name for name in scene.paths if name in scene.cameras)
    if len(names) < _MIN_PHOTOGRAPHS:
        raise ValueError(
            f"{folder} must have at least {_MIN_PHOTOGRAPHS} photographs with true cameras, has {len(names)}"
        )
    return TrialScene(scene, names)


Array = npt.NDArray[np.float64]

_PIXEL_CENTRE = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # from OpenCV's pixels to ours


def warp_image(image: Image, homography: Array, width: int, height: int) -> Image:
    """`image` through `homography` (3, 3), in pixels whose first centre is (0.5, 0.5); grey where it does not reach."""
    own = np.linalg.inv(_PIXEL_CENTRE) @ homography @ _PIXEL_CENTRE
    grey = (128.0, 128.0, 128.0)
    return cv2.warpPerspective(image, own, (width, height), flags=cv2.INTER_CUBIC, borderValue=grey).astype(np.uint8)


def render_turned_crops(photo: TrialImage, yaws_deg: Array, pitches_deg: Array) -> list[TrialImage]:
    """Views of half the width and height by a camera that turns where `photo` was taken: exactly K R K^-1.

    Angles are reduced where they would leave the photograph.
    """
    camera = _require_camera(photo)
    width, height = camera.width // 2, camera.height // 2
    K = camera.K.copy()
    K[:2, 2] = width / 2.0, height / 2.0
    # A rotated crop's far corner is further from the axis than the angle alone: 0.8 keeps it inside.
    limits = [0.8 * np.degrees(np.arctan(side / 4.0 / camera.K[0, 0])) for side in (camera.width, camera.height)]
    crops = []
    for number, (yaw, pitch) in enumerate(zip(yaws_deg, pitches_deg, strict=True)):
        angles = np.clip([yaw, pitch], [-limits[0], -limits[1]], limits)
        R_turned_camera = _compute_rotation(np.array([angles[1], -angles[0], 0.0]))
        image = warp_image(photo.image, K @ R_turned_camera @ np.linalg.inv(camera.K), width, height)
        T_world_camera = camera.T_world_camera.copy()
        T_world_camera[:3, :3] = T_world_camera[:3, :3] @ R_turned_camera.T
        crops.append(
            TrialImage(f"turned_{number}.png", image, TrueCamera(T_world_camera, K, width, height), photo.place)
        )
    return crops


def render_poster_views(poster: TrialImage, azimuths_deg: Array, distance: float = 1.0) -> list[TrialImage]:
    """The image of `poster`, as wide as 2 units and flat, seen from an arc around its middle; grey beyond."""
    width, height, focal = 800, 600, 720.0
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    rows, columns = poster.image.shape[:2]
    unit = 2.0 / columns
    T_plane_pixel = np.array([[unit, 0.0, -1.0], [0.0, unit, -unit * rows / 2.0], [0.0, 0.0, 1.0]])
    views = []
    for number, azimuth in enumerate(azimuths_deg):
        R_world_camera = _compute_rotation(np.array([3.0 * np.sin(number), azimuth, 2.0 * np.cos(number)]))
        centre = -distance * R_world_camera[:, 2]
        R_camera_world = R_world_camera.T
        plane_to_camera = np.stack([R_camera_world[:, 0], R_camera_world[:, 1], -R_camera_world @ centre], 1)
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3], T_world_camera[:3, 3] = R_world_camera, centre
        image = warp_image(poster.image, K @ plane_to_camera @ T_plane_pixel, width, height)
        camera = TrueCamera(T_world_camera, K, width, height)
        views.append(TrialImage(f"poster_{number}.png", image, camera, poster.place))
    return views


def mirror_image(photo: TrialImage) -> TrialImage:
    """The photograph's mirror image: what its camera would have seen in the mirrored world."""
    camera = _require_camera(photo)
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    K = camera.K.copy()
    K[0, 2] = camera.width - K[0, 2]
    seen = replace(camera, T_world_camera=flip @ camera.T_world_camera @ flip, K=K)
    return replace(photo, name=f"mirrored_{photo.name}", image=np.ascontiguousarray(photo.image[:, ::-1]), camera=seen)


def rotate_image(photo: TrialImage) -> TrialImage:
    """The photograph turned by 90 degrees clockwise, and its camera with it."""
    camera = _require_camera(photo)
    turn = np.eye(4)
    turn[:3, :3] = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # new x is the old -y, new y the old x
    K = camera.K.copy()
    K[0, 0], K[1, 1] = camera.K[1, 1], camera.K[0, 0]
    K[0, 2], K[1, 2] = camera.height - camera.K[1, 2], camera.K[0, 2]
    seen = TrueCamera(camera.T_world_camera @ turn, K, camera.height, camera.width)
    return replace(photo, image=np.ascontiguousarray(np.rot90(photo.image, -1)), camera=seen)


def resize_image(photo: TrialImage, share: float) -> TrialImage:
    height, width = (round(share * side) for side in photo.image.shape[:2])
    camera = _require_camera(photo)
    image = cv2.resize(photo.image, (width, height), interpolation=cv2.INTER_AREA if share < 1 else cv2.INTER_CUBIC)
    return replace(
        photo, image=image.astype(np.uint8), camera=_make_camera(camera, camera.K_for(width, height), image.shape)
    )


def crop_image(photo: TrialImage, share: float, left: float, top: float) -> TrialImage:
    """`share` of the width and height; `left` and `top` in [0, 1] say where between the two edges."""
    height, width = photo.image.shape[:2]
    x, y = round(left * (1 - share) * width), round(top * (1 - share) * height)
    return crop_rectangle(photo, x, y, round(share * width), round(share * height))


def crop_to_square(photo: TrialImage, where: float) -> TrialImage:
    """The largest square; `where` in [0, 1] says where between the two edges of the longer side."""
    height, width = photo.image.shape[:2]
    side = min(width, height)
    return crop_rectangle(photo, round(where * (width - side)), round(where * (height - side)), side, side)


def crop_rectangle(photo: TrialImage, x: int, y: int, width: int, height: int) -> TrialImage:
    """The pixels from column `x` and row `y` on."""
    image = np.ascontiguousarray(photo.image[y : y + height, x : x + width])
    camera = _require_camera(photo)
    K = camera.K.copy()
    K[:2, 2] -= x, y
    return replace(photo, image=image, camera=_make_camera(camera, K, image.shape))


def distort_image(photo: TrialImage, k1: float, k2: float = 0.0) -> TrialImage:
    """As a lens with these radial coefficients shows it; enlarged just enough that nothing is missing."""
    camera = _require_camera(photo)
    height, width = photo.image.shape[:2]
    corner = np.hypot(camera.K[0, 2] / camera.K[0, 0], camera.K[1, 2] / camera.K[1, 1])
    radials = np.array([k1, k2])
    K = np.diag([*[max(1.0, 1.0 / float(distortion(corner**2, radials)))] * 2, 1.0]) @ camera.K
    K[:2, 2] = camera.K[:2, 2]
    across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    seen = np.stack([(across - K[0, 2]) / K[0, 0], (down - K[1, 2]) / K[1, 1]], -1)
    true = seen.copy()
    for _ in range(20):  # a fixed point
        true = seen / distortion((true**2).sum(-1), radials)[..., None]
    source = (true * [camera.K[0, 0], camera.K[1, 1]] + camera.K[:2, 2] - 0.5).astype(np.float32)
    image = cv2.remap(photo.image, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return replace(photo, image=image.astype(np.uint8), camera=_make_camera(camera, K, image.shape))


def apply_rolling_shutter(photo: TrialImage, shift: float) -> TrialImage:
    """Read out row by row while the camera panned: the last row is `shift` times the width further than the first."""
    height, width = photo.image.shape[:2]
    across, down = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    source = across + np.float32(shift * width) * (down / np.float32(height) - np.float32(0.5))
    image = cv2.remap(photo.image, source, down, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return replace(photo, image=image.astype(np.uint8))


def _make_camera(camera: TrueCamera, K: Array, shape: Sequence[int]) -> TrueCamera:
    """The camera with the intrinsics `K` of an image of `shape` (H, W, ...)."""
    return TrueCamera(camera.T_world_camera, K, shape[1], shape[0])


def _require_camera(photo: TrialImage) -> TrueCamera:
    if photo.camera is None:
        raise ValueError(f"{photo.name} must have a true camera to be warped")
    return photo.camera


def _compute_rotation(degrees: Array) -> Array:
    return np.asarray(cv2.Rodrigues(np.radians(degrees))[0], np.float64)


# Corruptions of an image (H, W, 3) uint8 RGB: what light, sensor, shutter and file do. The camera stays as it was.

Grey = npt.NDArray[np.float32]


def add_noise(image: Image, sigma: float, rng: np.random.Generator) -> Image:
    """Independent noise of standard deviation `sigma` grey levels."""
    return _quantize(image + rng.normal(scale=sigma, size=image.shape))


def apply_motion_blur(image: Image, length_px: int, angle_deg: float) -> Image:
    """A linear smear of `length_px` pixels."""
    kernel = np.zeros((length_px, length_px), np.float32)
    kernel[length_px // 2] = 1.0
    middle = (length_px - 1) / 2.0
    kernel = cv2.warpAffine(
        kernel, cv2.getRotationMatrix2D((middle, middle), angle_deg, 1.0), (length_px, length_px)
    ).astype(np.float32)
    return _quantize(cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT))


def change_exposure(image: Image, gain: float, gamma: float, white_balance: npt.NDArray[np.float64]) -> Image:
    """As another exposure, tone curve and white balance (3,) would have shown it; highlights clip."""
    return _quantize(255.0 * np.clip(gain * white_balance * (image / 255.0), 0.0, 1.0) ** gamma)


def apply_vignetting(image: Image, loss: float) -> Image:
    """Darker towards the corners, where the share `loss` of the light is missing."""
    return _quantize(image * (1.0 - loss * _compute_radius(image) ** 2)[..., None])


def compress_jpeg(image: Image, quality: int) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def simulate_low_light(image: Image, photons: float, rng: np.random.Generator) -> Image:
    """A quarter of the brightness, with the shot noise of `photons` at white and 2 grey levels of read noise."""
    light = rng.poisson(image / 255.0 * photons) / photons
    return _quantize(0.25 * 255.0 * light + rng.normal(scale=2.0, size=image.shape))


def remove_texture(image: Image, share: float, from_side: int) -> Image:
    """The `share` of the image next to its side (0 left, 1 top, 2 right, 3 bottom) without its texture."""
    turned = np.rot90(image, from_side)
    columns = round(share * turned.shape[1])
    plain = cv2.GaussianBlur(turned[:, :columns], (0, 0), max(turned.shape) / 20.0)
    whole = np.concatenate([plain, turned[:, columns:]], axis=1).astype(np.uint8)
    return np.ascontiguousarray(np.rot90(whole, -from_side))


def render_white_wall(height: int, width: int, rng: np.random.Generator) -> Image:
    """A plain wall under uneven light, with sensor noise."""
    slope = rng.uniform(-15.0, 15.0, 2)
    down, across = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    light = 200.0 + slope[0] * down + slope[1] * across
    return _quantize(light[..., None] + rng.normal(scale=1.5, size=(height, width, 3)))


def generate_noise(height: int, width: int, rng: np.random.Generator) -> Image:
    return rng.integers(0, 256, (height, width, 3), dtype=np.uint8)


def make_patchwork(images: list[Image], height: int, width: int, cells: int, rng: np.random.Generator) -> Image:
    """`cells` x `cells` pieces from random places of random `images`."""
    result = np.zeros((height, width, 3), np.uint8)
    edges = [np.linspace(0, side, cells + 1).astype(int) for side in (height, width)]
    for top, bottom in zip(edges[0][:-1], edges[0][1:], strict=True):
        for left, right in zip(edges[1][:-1], edges[1][1:], strict=True):
            source = images[rng.integers(len(images))]
            y = rng.integers(source.shape[0] - (bottom - top))
            x = rng.integers(source.shape[1] - (right - left))
            result[top:bottom, left:right] = source[y : y + bottom - top, x : x + right - left]
    return result


def paste_patch(image: Image, patch: Image, mask: Grey, left: int, top: int) -> Image:
    """`patch` (h, w, 3) blended in by `mask` (h, w) in [0, 1], its corner at (left, top), which may lie outside."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + patch.shape[1], width), min(top + patch.shape[0], height)
    if x0 >= x1 or y0 >= y1:
        return image
    inside = np.s_[y0 - top : y1 - top, x0 - left : x1 - left]
    weight = mask[inside][..., None]
    result = image.copy()
    result[y0:y1, x0:x1] = _quantize(weight * patch[inside] + (1.0 - weight) * image[y0:y1, x0:x1])
    return result


def make_ellipse_mask(height: int, width: int) -> Grey:
    """(height, width) 1 inside the largest ellipse, with a soft edge of two pixels."""
    down, across = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    return np.clip((1.0 - np.hypot(down, across)) * min(height, width) / 4.0, 0.0, 1.0).astype(np.float32)


def add_highlight(image: Image, across: float, down: float, size: float) -> Image:
    """A lamp's reflection of `size` times the width, its middle at the shares (across, down) of the image."""
    height, width = image.shape[:2]
    y, x = np.mgrid[0:height, 0:width]
    distance = ((x - across * width) ** 2 + (y - down * height) ** 2) / (size * width) ** 2
    return _quantize(image + 400.0 * np.exp(-2.0 * distance)[..., None])


def repeat_left_half(image: Image) -> Image:
    """The left half twice, side by side: every structure has a double."""
    half = image[:, : image.shape[1] // 2]
    return np.concatenate([half, half], axis=1)


def _compute_radius(image: Image) -> npt.NDArray[np.float64]:
    """(H, W) distance from the middle, 1 in the corners."""
    height, width = image.shape[:2]
    down, across = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    return np.hypot(down, across) / np.sqrt(2.0)


def _quantize(values: npt.NDArray) -> Image:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
