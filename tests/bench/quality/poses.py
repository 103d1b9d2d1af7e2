"""How right and how fast the cameras are: `python -m tests.bench poses [SCENE ...] --out poses.json`.

Every set of splits.json goes through the same steps as in the pipeline: features, view graph, registration, verdict.
An answer is right when every relative rotation is within 2 degrees and the centres are within 5 % of their spread, and
beyond its claim when a camera is beyond 2.5 times its 95 % bound, or far off under a verdict that does not say rough;
the truth is used for nothing else. Seconds are of the wall and of the processor; the latter divided by the cores bounds
the former from below on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from splatnode.extras.evaluate.dataset import EvaluationScene, load_scene, load_split
from splatnode.extras.evaluate.protocol import compare_cameras
from splatnode.extras.evaluate.stability.trial import list_registered_cameras, measure_camera_errors
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.keyframes import Keyframe, resize_image
from splatnode.recon.matching import features
from splatnode.recon.matching.view_graph import match
from splatnode.recon.registration import registration as registration_registration
from splatnode.recon.registration.registration import Registration
from splatnode.recon.result.verdict import Code
from splatnode.recon.verification.decision import decide, refuse_before_registration
from splatnode.recon.verification.evidence import verify

RIGHT_ROTATION_DEG = 2.0
RIGHT_CENTRE_PCT = 5.0


@dataclass(frozen=True)
class Row:
    scene: str
    views: int
    code: str
    publishable: bool
    registered: int
    beyond: bool | None  # published beyond its claim; None: not published, or the truth is unknown
    right: bool | None  # None: nothing was placed, or the truth is unknown
    rotation_deg: float | None  # the largest error of any relative rotation
    rotation_median_deg: float | None  # the median error of the relative rotations
    centre_pct: float | None
    focal_pct: float | None
    seconds_features: float
    seconds_matching: float
    seconds_mapping: float
    seconds_verification: float
    seconds_processor: float

    @property
    def false_accept(self) -> bool:
        return self.beyond is True


def measure(scene: EvaluationScene, names: tuple[str, ...], config: ReconstructionConfig) -> Row:
    """One set of photographs from pixels to a verdict."""
    frames = scene.frames(names)
    processor, laps = time.process_time(), [time.perf_counter()]
    found = [features.extract(frame.image, config.matching.features) for frame in frames]
    laps.append(time.perf_counter())
    pictures = [resize_image(frame.image, config.size) for frame in frames]
    graph = match(map(Keyframe, frames, pictures, found), config.matching)
    laps.append(time.perf_counter())
    registration = registration_registration.register(graph.keyframes, graph.pairs, config.registration)
    laps.append(time.perf_counter())
    evidence = verify(graph, registration, config.verification)
    laps.append(time.perf_counter())
    verdict = refuse_before_registration(graph, (), config.decision) or decide(
        graph, registration, evidence, config.decision
    )
    seconds = np.diff(laps).tolist()
    errors = against_truth(scene, names, registration)
    estimate = Reconstruction(graph, registration, evidence, verdict)
    return Row(
        scene=scene.name,
        views=len(names),
        code=verdict.code.name,
        publishable=verdict.publishable,
        registered=0 if registration is None else len(registration.cameras),
        beyond=_beyond(scene, estimate),
        **errors,
        seconds_features=seconds[0],
        seconds_matching=seconds[1],
        seconds_mapping=seconds[2],
        seconds_verification=seconds[3],
        seconds_processor=time.process_time() - processor,
    )


def _beyond(scene: EvaluationScene, estimate: Reconstruction) -> bool | None:
    cameras = list_registered_cameras(estimate)
    if not estimate.publishable or not all(camera.name in scene.cameras for camera in cameras):
        return None
    rough = estimate.verdict.code is Code.OK_ROUGH
    return any(error.is_wrong(rough) for error in measure_camera_errors(cameras, scene.cameras))


def against_truth(
    scene: EvaluationScene, names: tuple[str, ...], registration: Registration | None
) -> dict[str, bool | float | None]:
    """The fields of `Row` that the truth decides."""
    known = [c for c in registration.cameras if names[c.index] in scene.cameras] if registration is not None else []
    if len(known) < 2:
        keys = ("right", "rotation_deg", "rotation_median_deg", "centre_pct", "focal_pct")
        return dict.fromkeys(keys)
    truth = [scene.cameras[names[camera.index]] for camera in known]
    estimated = np.stack([camera.T_world_camera for camera in known])
    true = np.stack([camera.T_world_camera for camera in truth])
    errors = compare_cameras(
        estimated,
        true,
        np.stack([np.diag([camera.focal, camera.focal, 1.0]) for camera in known]),
        np.stack([camera.K for camera in truth]),
    )
    first, second = np.triu_indices(len(known), 1)
    relative = [
        rotations[first].transpose(0, 2, 1) @ rotations[second] for rotations in (estimated[:, :3, :3], true[:, :3, :3])
    ]
    cosine = ((relative[0] * relative[1]).sum((1, 2)) - 1.0) / 2.0
    return {
        "right": (errors.rotation_pair_deg or 0.0) < RIGHT_ROTATION_DEG
        and (errors.centre_pct or 0.0) < RIGHT_CENTRE_PCT,
        "rotation_deg": errors.rotation_pair_deg,
        "rotation_median_deg": float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))),
        "centre_pct": errors.centre_pct,
        "focal_pct": errors.focal_pct,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", help="default: all of splits.json")
    parser.add_argument("--views", type=int, nargs="+", default=[3, 6, 12])
    parser.add_argument("--shared", type=Path, default=Path("../shared"), help="folder with scenes/")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    arguments = parser.parse_args()
    splits = json.loads((arguments.shared / "scenes" / "splits.json").read_text())
    rows = []
    for name in arguments.scenes or sorted(splits):
        scene = load_scene(arguments.shared / "scenes" / name)
        for views in arguments.views:
            if f"train{views}" in splits[name]:
                split = load_split(arguments.shared / "scenes" / name, list(scene.paths), views)
                rows.append(measure(scene, split.train, ReconstructionConfig()))
                print(json.dumps(asdict(rows[-1])), flush=True)
    published = [row for row in rows if row.publishable]
    summary = {
        "sets": len(rows),
        "published": len(published),
        "right": sum(row.right is True for row in published),
        "false_accepts": [f"{row.scene} {row.views}" for row in rows if row.false_accept],
    }
    print(json.dumps(summary))
    if arguments.out:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps({"summary": summary, "rows": [asdict(row) for row in rows]}, indent=1))


if __name__ == "__main__":
    main()
