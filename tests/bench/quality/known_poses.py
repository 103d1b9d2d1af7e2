"""Images whose poses and lens are told: `python -m tests.bench known_poses --out FILE [SCENE:VIEWS ...]`.

The true poses of each set, in metres that put the scene 1 m away, are told with errors of .001 m and .1 degrees, as
their sigmas say. In `clean` runs that is all; in `turn` and `shift` runs one pose is false besides, by 3 degrees or by
3 % of the distance. Cameras are compared with the true ones where they are, in the given world: nothing is aligned.
Matching does not depend on poses and is done once for each set. What --out holds already is not run again: a run that
was ended goes on, and further seeds are added.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import shlex
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Frame, make_given_pose
from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate.dataset import EvaluationScene, load_scene, load_split
from splatnode.recon.config import apply_changes, preset
from splatnode.recon.estimation import estimate_cameras, load_prior
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.pipeline import estimate_frame_cameras
from splatnode.recon.registration.known_poses import axis_depths
from splatnode.recon.threads import Clock

Array = npt.NDArray[np.float64]

SCENES = ("kitchen", "goldcape", "hard_temple_repeat", "hard_dino_lowtexture", "llff_fern", "castle_p30")
SETS = tuple(f"{scene}:{views}" for views in (3, 6) for scene in SCENES)
SIGMA_M, SIGMA_DEG = 0.001, 0.1  # of the poses, at 1 m from the scene
FALSE_M, FALSE_DEG = 0.03, 3.0
KINDS = ("clean", "turn", "shift")
CONFIG = apply_changes(preset("balanced"), {"registration": {"trust_poses": True}, "no_fallbacks": True})


@dataclass(frozen=True)
class Row:
    scene: str
    views: int
    kind: str  # clean, or what is false about one pose
    seed: int
    verdict: str
    placed: int
    # The largest error of a camera whose pose is true, in sigmas of the given pose: root of the mean of three squares
    centre_sigmas: float
    rotation_sigmas: float
    centre_over_bound: float  # the largest
    rotation_over_bound: float
    named: int  # poses, true ones among them
    named_right: bool | None  # whether the false one is among them; None: there is none
    seconds: float
    matches: int | None = None  # of the image whose pose is false with all others; 0: nothing can tell it is false


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", metavar="SCENE:VIEWS", default=list(SETS))
    parser.add_argument("--scenes", type=Path, default=Path("shared/scenes"), help="the folder of the scenes")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="runs of each kind and set")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    args = parser.parse_args()
    found = _read(args.out)
    done, matched = {_key(row) for row in found}, functools.cache(_match)
    # All sets and kinds of one seed after those of the other, so that what is there at any time is even
    for seed, name in itertools.product(range(args.seeds), map(str, args.sets)):
        scene, _, views = name.partition(":")
        for kind in KINDS if int(views) > 3 else KINDS[:1]:
            if (scene, int(views), kind, seed) in done:
                continue
            row = _row(matched(args.scenes / scene, int(views)), kind, seed)
            found.append(row)
            say(_told(row))
            _write(args.out, found)
    say(in_words(found))


@dataclass(frozen=True, eq=False)
class _Set:
    """A set of photographs, matched."""

    scene: EvaluationScene
    graph: ViewGraph
    away: float  # the distance of what they see, in the scene's unit


def _key(row: Row) -> tuple[str, int, str, int]:
    return row.scene, row.views, row.kind, row.seed


def _read(out: Path) -> list[Row]:
    return [Row(**row) for row in json.loads(out.read_text())["rows"]] if out.exists() else []


def _write(out: Path, found: list[Row]) -> None:
    sets = list(dict.fromkeys(f"{row.scene}:{row.views}" for row in found))
    seeds = max(row.seed for row in found) + 1
    command = shlex.join(["python", "-m", "tests.bench", "known_poses", *sets, f"--seeds={seeds}"])
    beside = out.with_suffix(".part")
    rows = sorted(map(asdict, found), key=lambda row: (sets.index(f"{row['scene']}:{row['views']}"), row["seed"]))
    beside.write_text(json.dumps({"command": command, "rows": rows}, indent=1) + "\n")
    beside.replace(out)


def _match(folder: Path, views: int) -> _Set:
    scene = load_scene(folder)
    frames = load_frames_with_lens(scene, load_split(folder, list(scene.cameras), views).train)
    alone = apply_changes(CONFIG, {"registration": {"trust_poses": False}})
    graph = estimate_frame_cameras(frames, load_prior(alone), alone, Clock())[0].graph
    return _Set(scene, graph, find_distance(scene))


def load_frames_with_lens(scene: EvaluationScene, names: Sequence[str]) -> list[Frame]:
    """The photographs, whose lens is told."""
    frames = []
    for frame in scene.frames(names):
        lens = scene.cameras[frame.name].intrinsics_for(frame.width, frame.height)
        frames.append(replace(frame, intrinsics=replace(lens, source="given")))
    return frames


def _row(matched: _Set, kind: str, seed: int) -> Row:
    scene, graph = matched.scene, matched.graph
    generator = np.random.default_rng(seed)
    false = None if kind == "clean" else int(generator.integers(len(graph.keyframes)))
    true, keyframes = {}, []
    for index, keyframe in enumerate(graph.keyframes):
        true[keyframe.name] = T = scene.cameras[keyframe.name].T_world_camera.copy()
        T[:3, 3] /= matched.away
        told = disturb_pose(T, generator, kind if index == false else "clean")
        frame = replace(keyframe.frame, given_pose=make_given_pose(told, SIGMA_M, SIGMA_DEG))
        keyframes.append(replace(keyframe, frame=frame))
    begun = time.process_time()
    estimate = estimate_cameras(replace(graph, keyframes=tuple(keyframes)), (), CONFIG)
    seconds = round(time.process_time() - begun, 2)
    given, registration = estimate.prior_world, estimate.registration
    matches = None if false is None else sum(len(pair.matches) for i, pair in graph.pairs.items() if false in i)
    told = scene.name, len(keyframes), kind, seed, estimate.verdict.code.value
    if given is None or registration is None:
        placed = 0 if registration is None else len(registration.cameras)
        right = None if false is None else False
        return Row(*told, placed, np.inf, np.inf, np.inf, np.inf, 0, right, seconds, matches)
    errors = []
    for camera in registration.cameras:
        name = graph.names[camera.index]
        centre = given.scale * given.rotation @ camera.T_world_camera[:3, 3] + given.translation
        turned = (given.rotation @ camera.T_world_camera[:3, :3]).T @ true[name][:3, :3]
        metres = float(np.linalg.norm(centre - true[name][:3, 3]))
        degrees = float(np.degrees(Rotation.from_matrix(turned).magnitude()))
        bounds, root = estimate.bounds[name], np.sqrt(3.0)
        over = metres / (given.scale * bounds.centre), degrees / bounds.rotation_deg
        if camera.index in given.held:
            errors.append((metres / SIGMA_M / root, degrees / SIGMA_DEG / root, *over))
    named = {each.index for each in given.deviations}
    right = None if false is None else false in named
    worst = np.array(errors).max(0).round(3).tolist()
    return Row(*told, len(registration.cameras), *worst, len(named), right, seconds, matches)


def disturb_pose(T: Array, generator: np.random.Generator, kind: str) -> Array:
    """The pose with errors as its sigmas say; false besides, if `kind` says so."""
    told = T.copy()
    aside = generator.normal(size=3)
    aside /= np.linalg.norm(aside)
    told[:3, 3] += SIGMA_M * generator.normal(size=3) + (FALSE_M * aside if kind == "shift" else 0.0)
    turn = np.radians(SIGMA_DEG) * generator.normal(size=3) + (np.radians(FALSE_DEG) * aside if kind == "turn" else 0.0)
    told[:3, :3] = told[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    return told


def find_distance(scene: EvaluationScene) -> float:
    """The median depth at which the true cameras' axes meet, in the unit of the scene."""
    Ts = np.stack([camera.T_world_camera for camera in scene.cameras.values()])
    return float(np.median(axis_depths(np.swapaxes(Ts[:, :3, :3], 1, 2), Ts[:, :3, 3])))


def _told(row: Row) -> str:
    named = f"{row.named} named" + {None: "", True: ", the false one", False: ", not the false one"}[row.named_right]
    errors = f"{row.centre_sigmas:.2f} and {row.rotation_sigmas:.2f} sigmas"
    over = f"{row.centre_over_bound:.2f} and {row.rotation_over_bound:.2f} of the bounds"
    placed = f"{row.verdict}, {row.placed} of {row.views} placed"
    return f"{row.scene} {row.kind} {row.seed}: {placed}, {errors}, {over}, {named}, {row.seconds:.1f} s"


def in_words(rows: list[Row]) -> str:
    """What the rows come to."""
    clean, false = ([row for row in rows if (row.kind == "clean") == which] for which in (True, False))
    right = sum(row.named_right is True for row in false)
    whole = sum(row.placed == row.views for row in clean)
    within = sum(max(row.centre_sigmas, row.rotation_sigmas) <= 2.0 for row in clean)
    told = [row for row in false if row.matches]
    of_matched = f", {sum(row.named_right is True for row in told)} of the {len(told)} whose image shares matches"
    return (
        f"clean: {whole} of {len(clean)} runs place all, {within} within 2 sigmas, {sum(row.named for row in clean)} "
        f"poses named; one false: named in {right} of {len(false)} runs{of_matched}"
    )


if __name__ == "__main__":
    main()
