"""What the share of multi-view consistent depth says of other views: `python -m tests.bench consistent_depth`.

Each case is a few photographs of a scene: SCENE:VIEWS of splits.json, or a pair SCENE:NAME+NAME. The reconstruction has
`preview`'s settings and finds its own cameras. A pair alone does not tell its focal length: it is given the lens that
the scene's largest split led to. Views away from the cameras are up to six held-out photographs whose true camera looks
where one of the case's looks: at most so far from the nearest of them, in place and direction, as the case's own
cameras lie apart. They are scored as in the benchmark, with a shorter search for their poses.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from torch import Tensor

from splatnode.capture.frame import Intrinsics
from splatnode.extras.evaluate.dataset import EvaluationScene, Split, load_scene, load_split
from splatnode.extras.evaluate.protocol import PerceptualNetworks, Run, Settings, compute_mean, evaluate, psnr, ssim
from splatnode.recon.config import preset
from splatnode.recon.geometry import angles_deg
from splatnode.recon.pipeline import run
from splatnode.recon.rasterize import rasterize_on_cpu
from tests.bench.quality.held_out import Case

CASES = (
    "fountain_p11:3",
    "fountain_p11:6",
    "entry_p10:3",
    "castle_p30:6",
    "llff_fern:3",
    "llff_flower:3",
    "kitchen:12",
    "fox:6",
    "sceaux:3",
    "sceaux:6",
    "tum_fr3_office:6",
    "fountain_p11:0002.jpg+0004.jpg",
    "fountain_p11:0002.jpg+0006.jpg",
    "fountain_p11:0005.jpg+0008.jpg",
    "entry_p10:0002.jpg+0004.jpg",
    "entry_p10:0001.jpg+0005.jpg",
    "castle_p30:0020.jpg+0023.jpg",
    "fox:0001.jpg+0012.jpg",
    "fox:0012.jpg+0044.jpg",
    "sceaux:100_7102.jpg+100_7105.jpg",
    "sceaux:100_7101.jpg+100_7107.jpg",
    "tum_fr3_office:1341847984.743352.jpg+1341847987.758741.jpg",
    "goldcape:IMG_5897.jpg+IMG_5905.jpg",
    "kitchen:13.jpg+15.jpg",
    "fountain_p11:0003.jpg+0007.jpg",
    "fountain_p11:0006.jpg+0009.jpg",
    "entry_p10:0004.jpg+0008.jpg",
    "sceaux:100_7104.jpg+100_7109.jpg",
)
MOST_TEST_VIEWS = 6
STEPS = 40  # of the search for a held-out view's pose: a third of the benchmark's
SEARCH = Settings(longer_side=384, alignment_steps=STEPS)

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True)
class HeldOut:
    name: str
    turn_deg: float  # from the direction of the case's camera that is nearest in direction
    psnr: float  # dB
    ssim: float


@dataclass(frozen=True)
class Row:
    scene: str
    photographs: tuple[str, ...]
    verdict: str
    apart_deg: float  # largest angle between a camera's direction and that of the camera most like it
    consistent_depth: float | None  # share of the pixels; None: no scene
    least: float | None  # that of the view which has least
    psnr: float | None  # dB, mean over the held-out photographs
    ssim: float | None
    held_out: tuple[HeldOut, ...]
    num_gaussians: int
    seconds: float  # of the processor, with the scores


def nearest(T: Matrix, others: Sequence[Matrix]) -> tuple[float, float]:
    """The least angle in degrees, and the least distance, from a camera (4, 4) to any of the others."""
    turns = [float(angles_deg(T[None, :3, :3], other[None, :3, :3])[0]) for other in others]
    return min(turns), min(float(np.linalg.norm(T[:3, 3] - other[:3, 3])) for other in others)


def held_out(scene: EvaluationScene, train: Sequence[str], candidates: Sequence[str]) -> tuple[str, ...]:
    """The candidates that look where the training views look, at most MOST_TEST_VIEWS, spread evenly."""
    cameras = {name: scene.cameras[name].T_world_camera for name in train}
    apart = [nearest(T, [other for key, other in cameras.items() if key != name]) for name, T in cameras.items()]
    turn, way = max(each[0] for each in apart), max(each[1] for each in apart)
    kept = []
    for name in candidates:
        found = nearest(scene.cameras[name].T_world_camera, list(cameras.values()))
        if found[0] <= turn and found[1] <= way:
            kept.append(name)
    chosen = np.linspace(0, len(kept) - 1, min(len(kept), MOST_TEST_VIEWS)).round().astype(int)
    return tuple(kept[index] for index in chosen)


def load_case(name: str, scenes: Path) -> Case:
    """The case called SCENE:VIEWS or SCENE:NAME+NAME."""
    folder, _, chosen = name.partition(":")
    scene = load_scene(scenes / folder)
    by_file = {path.name: key for key, path in scene.paths.items()}
    if "+" in chosen:
        train = tuple(by_file[each] for each in chosen.split("+"))
        candidates = [each for each in scene.cameras if each not in train]
    else:
        split = load_split(scenes / folder, list(scene.paths), int(chosen))
        train, candidates = split.train, [each for each in split.test if each in scene.cameras]
    return Case(scene, Split(train, held_out(scene, train, candidates)))


def lens(case: Case, scenes: Path) -> Intrinsics | None:
    """The lens that the largest split of the case's scene leads to, for photographs in full size."""
    splits = json.loads((scenes / "splits.json").read_text())[case.scene.name]
    most = max((key for key in splits if key.startswith("train")), key=lambda key: len(splits[key]))
    train = [name for name, path in case.scene.paths.items() if path.name in splits[most]]
    frames = case.scene.frames(train)
    snapshot = run(frames, preset("preview"))
    if not snapshot.cameras:
        return None
    camera, (height, width) = snapshot.cameras[0], frames[0].image.shape[:2]
    scale = width / camera.width
    fx, fy, cx, cy = (float(scale * camera.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Intrinsics(width, height, fx, fy, cx, cy, "given")


def measured(case: Case, scenes: Path) -> Row:
    frames = case.scene.frames(case.split.train)
    if len(frames) == 2:
        given = lens(case, scenes)
        frames = [replace(frame, intrinsics=given) for frame in frames]
    began = time.process_time()
    cameras = [case.scene.cameras[name].T_world_camera for name in case.split.train]
    apart = max(nearest(T, [each for each in cameras if each is not T])[0] for T in cameras)
    snapshot = run(frames, preset("preview"))
    shares = [camera.consistent_depth for camera in snapshot.cameras if camera.consistent_depth is not None]
    views: list[HeldOut] = []

    def keep(name: str, truth: Tensor, image: Tensor) -> None:
        turn = nearest(case.scene.cameras[name].T_world_camera, cameras)[0]
        views.append(HeldOut(name, round(turn, 1), round(psnr(image, truth), 2), round(ssim(image, truth), 4)))

    about = Run("preview", 0, None, {}, None)
    networks = PerceptualNetworks(None, None)
    evaluate(
        snapshot,
        case.scene,
        case.split,
        about,
        rasterize=rasterize_on_cpu,
        networks=networks,
        settings=SEARCH,
        show=keep,
    )
    return Row(
        scene=case.scene.name,
        photographs=case.split.train,
        verdict=snapshot.verdict.code.value,
        apart_deg=round(apart, 1),
        consistent_depth=_rounded(snapshot.consistent_depth, 4),
        least=_rounded(min(shares, default=None), 4),
        psnr=_rounded(compute_mean([view.psnr for view in views]), 2),
        ssim=_rounded(compute_mean([view.ssim for view in views]), 4),
        held_out=tuple(views),
        num_gaussians=len(snapshot.gaussians),
        seconds=round(time.process_time() - began, 1),
    )


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def known(out: Path) -> dict[str, Mapping[str, object]]:
    """The rows that the file holds already, by case."""
    return json.loads(out.read_text())["rows"] if out.exists() else {}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", help=f"default: {' '.join(CASES)}")
    parser.add_argument("--scenes", type=Path, default=Path("../shared/scenes"), help="folder with the scenes")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to fill; cases that it holds are kept")
    arguments = parser.parse_args()
    rows = known(arguments.out)
    for name in arguments.cases or CASES:
        if name in rows:
            continue
        rows[name] = asdict(measured(load_case(name, arguments.scenes), arguments.scenes))
        print(name, json.dumps(rows[name]), flush=True)
        content = {"command": "python -m tests.bench consistent_depth", "preset": "preview", "rows": rows}
        arguments.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
