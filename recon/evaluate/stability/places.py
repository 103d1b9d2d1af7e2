"""Where the photographs of the trials come from: recorded scenes with true cameras, or the built-in place."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Intrinsics
from splatnode.recon.evaluate.demo import write_capture
from splatnode.recon.evaluate.truth import EvaluationScene, TrueCamera, check_distinct_names, load_scene
from splatnode.recon.geometry import angles_deg

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
