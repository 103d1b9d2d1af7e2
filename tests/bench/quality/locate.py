"""Photographs placed in a saved scene, or refused: `python -m tests.bench locate [SCENE ...] --out locate.json`.

The training photographs of each set of splits.json (6 and 12 views) are reconstructed. Where the verdict publishes
them, the landmarks go through their file, and the held-out photographs of the set are placed by them alone, of unknown
lens. True cameras are carried into the scene by the similarity of the training cameras, as in the held-out evaluation.

covered  at least two training photographs of the scene share with the held-out one 30 matches that its true camera and
         theirs allow: OpenCV's SIFT at 800 pixels, ratio .8, Sampson error below 3 pixels. Nothing of ours tells it.
right    placed within 1 degree and 1 % of the distance to the scene, the median depth of its points

Then every held-out photograph is looked for in one set, the largest, of every other scene, where it must be refused.
castle_p30, entry_p10, fountain_p11 and hard_rotation_exact show one real courtyard: pairs of these count apart.
Seconds are of the processor, for photographs shrunk to 800 pixels, on one thread.

One of four held-out photographs is also placed as one that follows another: near to a camera that is beside its own,
and near to the farthest camera of the scene, which is wrong. A photograph of another scene is looked for near to three
cameras of the scene, too, as if these had taken it; what is refused there would be looked for everywhere, as above. A
video of the built-in capture is followed frame by frame.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.extras.evaluate.dataset import EvaluationScene, TrueCamera, load_scene, load_split
from splatnode.recon.config import ReconstructionConfig, preset
from splatnode.recon.core import set_threads
from splatnode.recon.estimation import Reconstruction, estimate_cameras, load_prior, prepare
from splatnode.recon.fallbacks import run_fallbacks
from splatnode.recon.geometry import align_cameras
from splatnode.recon.keyframes import screen_all
from splatnode.recon.locating import Located, NotLocated
from splatnode.recon.locating.localize import QUICK, follow, localize_image, localize_query, prepare_query_image
from splatnode.recon.matching.view_graph import match
from splatnode.recon.result.snapshot import Landmarks
from splatnode.recon.result.stored_snapshot import decode_landmarks, encode_landmarks
from tests.bench.quality.following import SIDE, FollowingFrame, errors_of, nearby, of_frames, placed_near, video
from tests.conftest import ROOT

Array = npt.NDArray[np.float64]

COURTYARD = {"castle_p30", "entry_p10", "fountain_p11", "hard_rotation_exact"}
RIGHT_DEG, RIGHT_PERCENT = 1.0, 1.0
RATIO, SAMPSON_PX, MATCHES, PARTNERS = 0.8, 3.0, 30, 2
_STEP = np.eye(4)
_STEP[:3, :3] = cv2.Rodrigues(np.radians([0.0, 3.0, 0.0]))[0]
EVERY = 4  # of the held-out photographs, one is timed


@dataclass(frozen=True)
class Trial:
    """A held-out photograph of the scene itself."""

    scene: str
    views: int
    photograph: str
    covered: bool
    outcome: str  # "placed", or the code of the refusal
    points: int = 0
    rotation_deg: float | None = None
    centre_percent: float | None = None
    rotation_claim_deg: float | None = None
    centre_claim_percent: float | None = None
    seconds: float | None = None  # of the processor, at 800 pixels; None: not measured
    seconds_following: float | None = None  # likewise, once it is known where one was taken that it follows
    rotation_following_deg: float | None = None  # the error then; None: it was refused, too
    centre_following_percent: float | None = None
    quickly: bool | None = None  # whether it was found near to that, without looking everywhere
    near_farthest: str | None = None  # near to the farthest camera of the scene: "right", "wrong", or "refused"

    @property
    def right(self) -> bool:
        errors = self.rotation_deg, self.centre_percent
        return all(e is not None and e <= most for e, most in zip(errors, (RIGHT_DEG, RIGHT_PERCENT), strict=True))


@dataclass(frozen=True)
class Stranger:
    """A photograph of another scene."""

    scene: str
    photograph_of: str
    photograph: str
    same_place: bool  # both scenes show the courtyard
    outcome: str
    outcome_following: str  # "placed" where it was, near to one of the scene's cameras; else "refused"


def estimated(scene: EvaluationScene, names: Sequence[str], config: ReconstructionConfig) -> Reconstruction:
    """Cameras and verdict, as `splatnode replay` finds them."""
    kept, _, rejected = screen_all(scene.frames(names), config.screening)
    prior = load_prior(config)
    graph = match([prepare(frame, config) for frame in kept], config.matching, prior.matcher)
    return run_fallbacks(estimate_cameras(graph, rejected, config), rejected, config)


def trials(scene: EvaluationScene, views: int, landmarks: Landmarks, names: Sequence[str]) -> Iterator[Trial]:
    """Each of the held-out photographs `names`."""
    true = np.stack([scene.cameras[name].T_world_camera for name in landmarks.names])
    to_scene = align_cameras(true, landmarks.Ts_world_camera)
    known = {name: _keypoints(scene, name) for name in (*landmarks.names, *names)}
    for number, name in enumerate(names):
        partners = sum(
            _shared(known[name], scene.cameras[name], known[other], scene.cameras[other]) >= MATCHES
            for other in landmarks.names
        )
        image = scene.image(name)
        found = localize_image(landmarks, image)
        truth = to_scene.camera(scene.cameras[name].T_world_camera)
        timed = _timed(landmarks, image, truth) if number % EVERY == 0 else {}
        errors = errors_of(found, truth, landmarks.unit)
        yield Trial(scene.name, views, name, partners >= PARTNERS, outcome(found), **errors, **timed)


def outcome(found: Located | NotLocated) -> str:
    return "placed" if isinstance(found, Located) else found.code.value


def _timed(landmarks: Landmarks, image: npt.NDArray[np.uint8], truth: Array) -> dict[str, Any]:
    """Seconds at 800 pixels; then those of one that follows it: the same photograph, beside the nearest of the scene.

    What it follows was taken a tenth of the distance to the scene, and 3 degrees, from it.
    """
    small, begun = _shrunk(image), time.process_time()
    first = localize_image(landmarks, small)
    seconds = {"seconds": time.process_time() - begun}
    if isinstance(first, NotLocated):
        return seconds
    before = first.T_world_camera @ _STEP
    before[:3, 3] = first.T_world_camera[:3, 3] + 0.1 * landmarks.unit * first.T_world_camera[:3, 0]
    begun = time.process_time()
    found = follow(landmarks, small, replace(first, T_world_camera=before))
    seconds["seconds_following"] = time.process_time() - begun
    errors = errors_of(found, truth, landmarks.unit)
    return (
        seconds
        | {
            f"{kind}_following_{unit}": errors[f"{kind}_{unit}"]
            for kind, unit in (("rotation", "deg"), ("centre", "percent"))
            if errors
        }
        | nearby(landmarks, small, first, before)
    )


def _shrunk(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    scale = min(1.0, SIDE / max(image.shape[:2]))
    size = round(scale * image.shape[1]), round(scale * image.shape[0])
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


Keypoints = tuple[Array, npt.NDArray[np.float32], tuple[int, int]]  # pixels (M, 2), descriptors (M, 128), size


def _keypoints(scene: EvaluationScene, name: str) -> Keypoints:
    grey = cv2.cvtColor(_shrunk(scene.image(name)), cv2.COLOR_RGB2GRAY)
    found, descriptors = cv2.SIFT.create(3000).detectAndCompute(grey, None)  # pyright: ignore[reportArgumentType]
    pixels = np.array([point.pt for point in found]) + 0.5
    return pixels, np.asarray(descriptors, np.float32), (grey.shape[1], grey.shape[0])


def _shared(one: Keypoints, camera1: TrueCamera, other: Keypoints, camera2: TrueCamera) -> int:
    """Matches that the true cameras allow."""
    pairs = cv2.BFMatcher().knnMatch(one[1], other[1], k=2)
    good = [(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < RATIO * b.distance]
    if not good:
        return 0
    first, second = (
        np.column_stack([points[list(i)], np.ones(len(i))])
        for points, i in zip((one[0], other[0]), zip(*good, strict=True), strict=True)
    )
    between = np.linalg.inv(camera2.T_world_camera) @ camera1.T_world_camera
    x, y, z = between[:3, 3]
    K1, K2 = camera1.K_for(*one[2]), camera2.K_for(*other[2])
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ between[:3, :3]
    fundamental = np.linalg.inv(K2).T @ essential @ np.linalg.inv(K1)
    line2, line1 = first @ fundamental.T, second @ fundamental
    error = np.abs((second * line2).sum(1)) / np.sqrt((line2[:, :2] ** 2).sum(1) + (line1[:, :2] ** 2).sum(1))
    return int((error < SAMPSON_PX).sum())


def summary(
    own: Sequence[Trial], strangers: Sequence[Stranger], frames: Sequence[FollowingFrame] = ()
) -> dict[str, object]:
    """What docs/measurement.md prints."""
    covered, placed = [t for t in own if t.covered], [t for t in own if t.outcome == "placed"]
    apart = [s for s in strangers if not s.same_place]
    seconds = [t.seconds for t in own if t.seconds is not None]
    timed = [t for t in own if t.quickly is not None]
    following = [t.seconds_following for t in own if t.seconds_following is not None]
    within = {
        "rotation": [(t.rotation_deg or 0.0) <= (t.rotation_claim_deg or 0.0) for t in placed],
        "centre": [(t.centre_percent or 0.0) <= (t.centre_claim_percent or 0.0) for t in placed],
    }
    return {
        "trials": len(own),
        "covered": len(covered),
        "covered_and_right": sum(t.right for t in covered),
        "placed": len(placed),
        "placed_right": sum(t.right for t in placed),
        "within_claim": {kind: sum(values) for kind, values in within.items()},
        "largest_error": [
            max(e or 0.0 for e in errors)
            for errors in zip(*[(t.rotation_deg, t.centre_percent) for t in placed], strict=True)
        ],
        "strangers": len(apart),
        "strangers_placed": sum(s.outcome == "placed" for s in apart),
        "courtyard_pairs": len(strangers) - len(apart),
        "courtyard_placed": sum(s.outcome == "placed" for s in strangers if s.same_place),
        "seconds_median": float(np.median(seconds)) if seconds else None,
        "seconds_most": max(seconds, default=None),
        "seconds_following_median": float(np.median(following)) if following else None,
        "seconds_following_most": max(following, default=None),
        "following": len(timed),
        "following_quickly": sum(bool(t.quickly) for t in timed),
        "seconds_quickly_most": max((t.seconds_following or 0.0 for t in timed if t.quickly), default=None),
        "near_farthest": {
            outcome: sum(t.near_farthest == outcome for t in timed) for outcome in ("right", "wrong", "refused")
        },
        "strangers_followed": sum(s.outcome_following == "placed" for s in apart),
        **of_frames(frames),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", help="default: all of splits.json that have true cameras")
    parser.add_argument("--views", type=int, nargs="+", default=[6, 12])
    parser.add_argument("--shared", type=Path, default=Path("../shared"), help="folder with scenes/")
    parser.add_argument("--strangers", type=int, default=100, help="held-out photographs of a scene, for other scenes")
    parser.add_argument("--videos", type=int, default=3, help="of places of the built-in capture")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    set_threads(1)
    splits = json.loads((args.shared / "scenes" / "splits.json").read_text())
    scenes = {name: load_scene(args.shared / "scenes" / name) for name in args.scenes or sorted(splits)}
    sets: dict[str, str] = {}
    largest: dict[str, Landmarks] = {}
    own: list[Trial] = []
    for name, scene in scenes.items():
        for views in (views for views in args.views if f"train{views}" in splits[name]):
            split = load_split(args.shared / "scenes" / name, list(scene.paths), views)
            estimate = estimated(scene, split.train, preset("balanced"))
            sets[f"{name} {views}"] = estimate.verdict.code.value
            if estimate.landmarks is None:
                continue
            data = encode_landmarks(estimate.landmarks)
            sets[f"{name} {views}"] += f", {len(data)} bytes"
            largest[name] = decode_landmarks(data)
            own += trials(scene, views, largest[name], split.test)
        print(name, json.dumps(summary(own, [])), flush=True)
    frames = [frame for place in range(args.videos) for frame in video(place)]
    _write(args.out, sets, own, [], frames)
    strangers = list(_strangers(scenes, {name: splits[name]["test"][: args.strangers] for name in scenes}, largest))
    _write(args.out, sets, own, strangers, frames)
    print(json.dumps(summary(own, strangers, frames)))


def _write(
    path: Path,
    sets: dict[str, str],
    own: Sequence[Trial],
    strangers: Sequence[Stranger],
    frames: Sequence[FollowingFrame],
) -> None:
    head = {"command": shlex.join(["python", "-m", "tests.bench", "locate", *sys.argv[1:]]), "commit": head_commit()}
    rows = {
        "trials": [asdict(trial) for trial in own],
        "strangers": [asdict(pair) for pair in strangers],
        "frames": [asdict(frame) for frame in frames],
    }
    found = summary(own, strangers, frames)
    path.write_text(json.dumps({**head, "summary": found, "sets": sets, **rows}, indent=1) + "\n")


def _strangers(
    scenes: dict[str, EvaluationScene], photographs: dict[str, list[str]], known: dict[str, Landmarks]
) -> Iterator[Stranger]:
    for of, scene in scenes.items():
        for name in photographs[of]:
            image = scene.image(name)
            photograph, quick = prepare_query_image(image), prepare_query_image(_shrunk(image), None, QUICK)
            for other, landmarks in known.items():
                if other != of:
                    found = outcome(localize_query(landmarks, photograph))
                    following = "placed" if placed_near(landmarks, quick) else "refused"
                    yield Stranger(other, of, name, {of, other} <= COURTYARD, found, following)


def head_commit() -> str:
    head = ["git", "rev-parse", "--short=7", "HEAD"]
    return subprocess.run(head, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
