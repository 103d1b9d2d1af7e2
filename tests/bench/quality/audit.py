"""Moves of cameras, and none: `python -m tests.bench audit [SCENE ...] --out audit.json`.

The training photographs of each scene (6 views) are reconstructed, and those of the built-in capture. Where the verdict
publishes them, held-out photographs stand for the cameras of a station. Each is compared with itself as another day
would have it: brighter or darker by up to 40 %, with noise of 1 to 4 grey levels, compressed as JPEG of quality 50 to
95, and with a piece of another photograph over up to 20 % of it.

still    nothing moved: a move that is told is a false alarm
turned   by DEGREES about any axis through its centre: a real photograph is warped, of the built-in capture one is made
shifted  by PERCENT of the distance to the scene in any direction: the built-in capture alone
pair     two held-out photographs, one after the other: the motion that is measured, against the true cameras
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.capture.process.terminal import say
from splatnode.extras.audit import MeasuredMotion, measure_motion, twist
from splatnode.extras.evaluate.dataset import EvaluationScene, load_scene, load_split
from splatnode.recon.config import preset
from splatnode.recon.core import set_threads
from splatnode.recon.estimation import estimate_cameras
from splatnode.recon.geometry import align_cameras
from splatnode.recon.locating.localize import Localization, localize_with_inliers, prepare_query_image
from splatnode.recon.result.snapshot import Landmarks
from tests.bench.quality.locate import estimated
from tests.support.synthetic import photographs, view_graph

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

DEGREES, PERCENT = 0.3, 0.5
SIDE = 800  # pixels, of the photographs
CAMERAS = 6  # of a scene at most
PLACE = synthetic.Config(views=6, width=640, height=480)
BUILT_IN = "built-in"


@dataclass(frozen=True)
class Check:
    scene: str
    photograph: str
    kind: str  # still, turned, shifted, pair
    noticed: bool
    common: int  # points that both show
    degrees: float  # the turn that was measured
    percent: float  # and the shift, of the distance
    least_turn_deg: float
    least_shift_percent: float
    error_sigmas: float  # of the motion that was measured against the true one, in standard deviations (6 dimensions)


def another_day(image: Image, other: Image, generator: np.random.Generator) -> Image:
    """The photograph with other light, noise and compression, and a piece of `other` over up to 20 % of it."""
    height, width = image.shape[:2]
    changed = image.astype(np.float64)
    share = np.sqrt(generator.uniform(0.0, 0.2))
    h, w = round(share * height), round(share * width)
    top, left = generator.integers(0, height - h + 1), generator.integers(0, width - w + 1)
    changed[top : top + h, left : left + w] = cv2.resize(other, (width, height))[:h, :w]
    changed = changed * generator.uniform(0.6, 1.4) + generator.normal(0.0, generator.uniform(1.0, 4.0), changed.shape)
    levels = np.clip(changed, 0, 255).astype(np.uint8)
    _, data = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, int(generator.integers(50, 96))])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def any_direction(generator: np.random.Generator) -> Array:
    direction = generator.normal(size=3)
    return direction / np.linalg.norm(direction)


def turn(generator: np.random.Generator) -> Array:
    """(4, 4) by DEGREES about any axis."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.radians(DEGREES) * any_direction(generator))[0]
    return T


def warped(image: Image, K: Array, T: Array) -> Image:
    """What the camera sees once it has turned by T (4, 4), without its shift."""
    height, width = image.shape[:2]
    middle = (
        np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]]) @ K
    )  # OpenCV's pixels begin at their middle
    back = middle @ T[:3, :3] @ np.linalg.inv(middle)  # from a pixel of the turned camera to one of the photograph
    flags = cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpPerspective(image, back, (width, height), flags=flags, borderMode=cv2.BORDER_REFLECT), np.uint8
    )


def check(scene: str, name: str, kind: str, found: MeasuredMotion, true: Array, unit: float) -> Check:
    error = twist(np.linalg.inv(true) @ found.T_before_after)
    return Check(
        scene,
        name,
        kind,
        found.is_significant,
        found.common,
        round(found.degrees, 4),
        round(100.0 * found.distance / unit, 4),
        round(found.least_turn_deg, 4),
        round(100.0 * found.least_shift / unit, 4),
        round(float(np.sqrt(error @ np.linalg.solve(found.covariance, error))), 3),
    )


def of_scene(scene: EvaluationScene, landmarks: Landmarks, names: Sequence[str], times: int) -> Iterator[Check]:
    """Real photographs."""
    generator = np.random.default_rng(0)
    true = np.stack([scene.cameras[name].T_world_camera for name in landmarks.names])
    to_scene = align_cameras(true, landmarks.Ts_world_camera)
    images = {name: shrunk(scene.image(name)) for name in names}
    before: tuple[str, Localization] | None = None
    for name in names:
        first = localize_with_inliers(landmarks, prepare_query_image(images[name]))
        if not isinstance(first, Localization):
            continue
        other = images[names[int(generator.integers(len(names)))]]
        for number in range(times):
            T = turn(generator) if number % 2 else np.eye(4)
            image = warped(images[name], first.located.K, T) if number % 2 else images[name]
            second = localize_with_inliers(landmarks, prepare_query_image(another_day(image, other, generator)))
            if isinstance(second, Localization):
                yield check(
                    scene.name,
                    name,
                    "turned" if number % 2 else "still",
                    measure_motion(first, second),
                    T,
                    landmarks.unit,
                )
        if before is not None:
            Ts = [to_scene.camera(scene.cameras[each].T_world_camera) for each in (before[0], name)]
            found = measure_motion(before[1], first)
            yield check(scene.name, name, "pair", found, np.linalg.inv(Ts[0]) @ Ts[1], landmarks.unit)
        before = name, first


def of_built_in(times: int) -> Iterator[Check]:
    """Photographs of the built-in capture, taken again."""
    generator = np.random.default_rng(0)
    estimate = estimate_cameras(view_graph(photographs(PLACE)), (), preset("balanced"))
    landmarks = estimate.landmarks
    assert landmarks is not None
    to_scene = align_cameras(np.stack([T for T, _ in synthetic.scene_cameras(PLACE)]), landmarks.Ts_world_camera)
    cameras = synthetic.evaluation_cameras(PLACE)
    for index, (T_world_camera, K) in enumerate(cameras):
        name = f"held_out_{index}"
        other = synthetic.render_image(PLACE, cameras[(index + 2) % len(cameras)], 900)
        first = localize_with_inliers(
            landmarks, prepare_query_image(synthetic.render_image(PLACE, (T_world_camera, K), 1000 + index))
        )
        if not isinstance(first, Localization):
            continue
        moves: dict[str, Callable[[], Array]] = {
            "still": lambda: np.eye(4),
            "turned": lambda: turn(generator),
            "shifted": lambda: shift(generator, 0.01 * PERCENT * landmarks.unit / to_scene.scale),
        }
        for number in range(times):
            for kind, move in moves.items():
                T = move()
                image = synthetic.render_image(PLACE, (T_world_camera @ T, K), 10 * number + index)
                second = localize_with_inliers(landmarks, prepare_query_image(another_day(image, other, generator)))
                if isinstance(second, Localization):
                    in_scene = T.copy()
                    in_scene[:3, 3] *= to_scene.scale
                    yield check(BUILT_IN, name, kind, measure_motion(first, second), in_scene, landmarks.unit)


def shift(generator: np.random.Generator, length: float) -> Array:
    T = np.eye(4)
    T[:3, 3] = length * any_direction(generator)
    return T


def shrunk(image: Image) -> Image:
    scale = min(1.0, SIDE / max(image.shape[:2]))
    size = round(scale * image.shape[1]), round(scale * image.shape[0])
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def summary(checks: Sequence[Check]) -> dict[str, object]:
    """What docs/measurement.md prints."""
    by_kind = {kind: [c for c in checks if c.kind == kind] for kind in ("still", "turned", "shifted", "pair")}
    still = by_kind["still"]
    return {
        "scenes": sorted({c.scene for c in checks}),
        "checks": {kind: len(found) for kind, found in by_kind.items()},
        "noticed": {kind: sum(c.noticed for c in found) for kind, found in by_kind.items()},
        "least_turn_deg": spread([c.least_turn_deg for c in still]),
        "least_shift_percent": spread([c.least_shift_percent for c in still]),
        "pairs_within_95": sum(c.error_sigmas**2 < 12.59 for c in by_kind["pair"]),  # chi-squared, 6 degrees of freedom
        "most_still_sigmas": max((c.error_sigmas for c in still), default=None),
    }


def spread(values: Sequence[float]) -> list[float]:
    """Median, 95 % quantile, largest."""
    return [round(float(np.quantile(values, q)), 4) for q in (0.5, 0.95, 1.0)] if values else []


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", help="default: all of splits.json with 6 views")
    parser.add_argument("--times", type=int, default=20, help="that a real photograph is taken again (default: 20)")
    parser.add_argument("--shared", type=Path, default=Path("../shared"), help="folder with scenes/")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    set_threads(1)
    splits = json.loads((args.shared / "scenes" / "splits.json").read_text())
    checks = list(of_built_in(args.times))
    for name in args.scenes or sorted(name for name in splits if "train6" in splits[name]):
        scene = load_scene(args.shared / "scenes" / name)
        split = load_split(args.shared / "scenes" / name, list(scene.paths), 6)
        landmarks = estimated(scene, split.train, preset("balanced")).landmarks
        if landmarks is not None:
            checks += of_scene(scene, landmarks, split.test[:CAMERAS], args.times)
        say(f"{name}: {json.dumps(summary(checks))}")
    command = shlex.join(["python", "-m", "tests.bench", "audit", *sys.argv[1:]])
    found = {"command": command, "summary": summary(checks), "checks": [asdict(each) for each in checks]}
    args.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
