"""Several different cameras on one place: `python -m tests.bench several_cameras SCENE ... --out FILE`.

For each scene, number of images, mix of cameras and setting (lenses of all told, of the first camera alone, of none),
a window that overlaps well is photographed by the cameras in turn: each crops the photographs to its field of view,
has its own size, or bends them as a fisheye. The same window by one camera is beside it. Wrong is a camera beyond 2.5
times a bound, or beyond 5 degrees or 10 % of the distance without the word rough.
"""

from __future__ import annotations

import argparse
import json
import time
import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses import undistort_frame, unproject
from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate.dataset import TrueCamera, load_scene
from splatnode.extras.evaluate.stability.perturbations import TrialImage, TrialScene
from splatnode.extras.evaluate.stability.trial import ROUGH, CameraError, list_registered_cameras, score_cameras
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import load_prior
from splatnode.recon.pipeline import estimate_frame_cameras
from splatnode.recon.threads import Clock
from tests.bench.quality.lens_assumptions import find_answered, format_answers, window

COUNTS = (6, 9)  # images of a trial
SETTINGS = ("told", "half", "nothing")  # of the lenses
ONE = "one"


@dataclass(frozen=True)
class CameraKind:
    """How a camera differs from the one that took the photographs."""

    name: str
    zoom: float = 1.0  # its focal length over that of the photographs, in longer sides of the picture
    size: float = 1.0  # its sides over those of the photographs
    fisheye: bool = False


BASE = CameraKind("base")
MIXES: dict[str, tuple[CameraKind, ...]] = {
    ONE: (BASE,),
    "1.02": (BASE, CameraKind("near", 1.02)),
    "1.2, other size": (BASE, CameraKind("other", 1.2, 0.8)),
    "1.5": (BASE, CameraKind("tele", 1.5)),
    "2, other size": (BASE, CameraKind("tele", 2.0, 0.6)),
    "fisheye": (BASE, CameraKind("fisheye", fisheye=True)),
    "1.1 and 1.4": (BASE, CameraKind("near", 1.1, 0.9), CameraKind("tele", 1.4, 0.75)),
    "1.3 and fisheye": (BASE, CameraKind("tele", 1.3, 0.8), CameraKind("fisheye", 1.0, 0.9, fisheye=True)),
}


@dataclass(frozen=True)
class Trial:
    """One line of the result. Ratios are errors over bounds, the largest of all cameras; None without an answer."""

    scene: str
    count: int
    mix: str
    setting: str
    verdict: str
    published: bool
    wrong: bool
    exact: bool  # every camera within 2 degrees and 5 % of the spread, published or not
    num_cameras: int
    seconds: float
    message: str
    errors: tuple[CameraError, ...]


def photograph(photo: TrialImage, kind: CameraKind, told: bool, number: int) -> tuple[Frame, TrueCamera]:
    """What a camera sees in place of the photograph's, and the camera that is true of what is matched in it."""
    height, width = photo.image.shape[:2]
    if photo.camera is None:
        raise ValueError(f"{photo.name} must have a true camera")
    K = photo.camera.K_for(width, height)
    size = round(kind.size * width), round(kind.size * height)
    shown = np.diag([kind.zoom * size[0] / width, kind.zoom * size[1] / height, 1.0]) @ K
    shown[:2, 2] = size[0] / 2, size[1] / 2
    corner = np.hypot(*size) / 2 / shown[0, 0]
    if kind.fisheye:  # the widest ray is that of the photograph's corner
        shown[[0, 1], [0, 1]] *= corner / np.arctan(corner)
    lens = Intrinsics(
        *size, shown[0, 0], shown[1, 1], *shown[:2, 2], "given",
        (0.0, 0.0, 0.0, 0.0) if kind.fisheye else (), "fisheye" if kind.fisheye else "opencv",
    )  # fmt: skip
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = unproject(np.stack([columns, rows], -1).reshape(-1, 2), lens)
    sought = (rays[:, :2] / rays[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2] - 0.5).reshape(size[1], size[0], 2)
    smooth = cv2.GaussianBlur(photo.image, (0, 0), 0.4 / kind.size) if kind.size < 0.9 * kind.zoom else photo.image
    image = cv2.remap(smooth, *np.moveaxis(sought.astype(np.float32), 2, 0), cv2.INTER_LANCZOS4).astype(np.uint8)
    camera_id = kind.name
    frame = Frame(number, f"{camera_id}/{photo.name}", number, image, lens if told else None, camera_id=camera_id)
    straight = undistort_frame(frame) if told else frame
    known = straight.intrinsics or replace(lens, distortion=(), model="opencv")
    return frame, TrueCamera(photo.camera.T_world_camera, known.K, straight.width, straight.height)


def run_trial(photos: Sequence[TrialImage], mix: str, setting: str, config: ReconstructionConfig) -> Trial:
    kinds, made = MIXES[mix], {}
    for number, photo in enumerate(photos):
        place = number % len(kinds)
        told = setting == "told" or (setting == "half" and place == 0)
        frame, camera = photograph(photo, kinds[place], told, number)
        made[frame.name] = frame, camera
    started = time.perf_counter()
    frames = [frame for frame, _ in made.values()]
    estimate, _ = estimate_frame_cameras(frames, load_prior(config), config, Clock())
    seconds = time.perf_counter() - started
    cameras, published = list_registered_cameras(estimate), estimate.verdict.publishable
    world = {name: camera for name, (_, camera) in made.items()}
    score = score_cameras(cameras, (world,), rough=estimate.verdict.code.value == ROUGH)
    return Trial(
        photos[0].place, len(photos), mix, setting, estimate.verdict.code.value, published,
        published and not score.right, score.exact, len(cameras) if published else 0, seconds,
        estimate.verdict.message, score.errors,
    )  # fmt: skip


def run_scene(
    folder: Path,
    counts: Sequence[int],
    mixes: Sequence[str],
    settings: Sequence[str],
    sample: int | None,
    journal: Path,
) -> list[Trial]:
    """`sample`: at most so many mixes for each number of images and setting, drawn at random, besides one camera."""
    scene = load_scene(folder)
    place = TrialScene(scene, tuple(name for name in scene.paths if name in scene.cameras))
    config, found = ReconstructionConfig(), []
    for count in counts:
        photos = window(place, count)
        for setting in settings if photos else ():
            seed = np.random.default_rng([count, zlib.crc32(f"{place.name} {setting}".encode())])
            drawn = seed.permutation([mix for mix in mixes if mix != ONE]).tolist()[:sample]
            for mix in [ONE, *drawn]:
                found.append(run_trial(photos, mix, setting, config))
                with journal.open("a") as lines:
                    lines.write(json.dumps(asdict(found[-1])) + "\n")
    return found


def table(trials: Sequence[Trial]) -> Iterator[str]:
    """Of each mix and setting: trials, answered, wrong, and the share of those that one camera answers."""
    alone = find_answered([t for t in trials if t.mix == ONE])
    groups: dict[tuple[str, str], list[Trial]] = defaultdict(list)
    for trial in trials:
        groups[trial.mix, trial.setting].append(trial)
    several = [t for t in trials if t.mix != ONE]
    totals = [(("all mixes", setting), [t for t in several if t.setting == setting]) for setting in SETTINGS]
    for (mix, setting), rows in [*sorted(groups.items()), *totals, (("all mixes", "any"), several)]:
        yield f"{mix:18s} {setting:8s} {format_answers(rows, alone, 'one camera')}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True, help="JSON file; FILE.jsonl beside it grows meanwhile")
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--mixes", nargs="+", default=list(MIXES))
    parser.add_argument("--settings", nargs="+", default=SETTINGS)
    parser.add_argument("--sample", type=int, help="mixes for each scene, number of images and setting, at most")
    arguments = parser.parse_args()
    journal = arguments.out.with_suffix(".jsonl")
    trials = [
        trial
        for scene in arguments.scenes
        for trial in run_scene(scene, arguments.counts, arguments.mixes, arguments.settings, arguments.sample, journal)
    ]
    lines = list(table(trials))
    arguments.out.write_text(json.dumps({"table": lines, "trials": [asdict(t) for t in trials]}, indent=1))
    for line in lines:
        say(line)


if __name__ == "__main__":
    main()
