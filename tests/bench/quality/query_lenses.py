"""Query images of another lens than the scene's: `python -m tests.bench query_lenses [SCENE ...] --out FILE`.

The training images of a scene (splits.json) are reconstructed without reading a true camera. Held-out images are
warped (query_warps.py): zoomed, cropped, mirrored and more, and localised by the scene's landmarks alone. True cameras
are carried into the scene by the similarity of its training cameras.

wrong   placed with an error of rotation, centre or focal length beyond 2.5 times its bound; or placed at all, where
        no camera takes such an image (mirrored)
right   placed, and not wrong

Thresholds were chosen on the first half of the scenes; both halves are reported. With --told the unwarped image's lens
is stated, as EXIF does and as a calibration does, also where the zoom makes it wrong. Seconds are of the processor, one
thread, features included.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics
from splatnode.extras.evaluate.dataset import EvaluationScene, load_scene, load_split
from splatnode.recon.config import preset
from splatnode.recon.core import set_threads
from splatnode.recon.geometry import align_cameras
from splatnode.recon.locating import Located, NotLocated
from splatnode.recon.locating.localize import localize_image
from splatnode.recon.result.snapshot import Landmarks
from splatnode.recon.result.stored_snapshot import decode_landmarks, encode_landmarks
from tests.bench.quality.following import errors_of
from tests.bench.quality.locate import estimated, head_commit, outcome
from tests.bench.quality.query_warps import BAR, CLEAN, WARPS, Query

Array = npt.NDArray[np.float64]

WRONG = 2.5  # times its bound
# Scene -> training views. Thresholds were chosen on the first half.
CHOSEN_ON = {"castle_p30": 12, "fox": 12, "kitchen": 12, "llff_fern": 6, "tum_fr3_office": 6}
LEFT_OUT = {"fountain_p11": 6, "goldcape": 12, "hard_bridge_drone": 12, "llff_flower": 12, "sceaux": 6}
TOLD_WARPS = (CLEAN, "zoom 1.1", "zoom 1.3", "zoom 2.0")


@dataclass(frozen=True)
class Trial:
    """A warped held-out image, localised."""

    scene: str
    image: str
    warp: str
    told: str  # what was stated of the lens: "", "exif" or "given"
    outcome: str  # "placed", or the code of the refusal
    seconds: float
    pose: bool  # whether a camera in the scene takes such an image
    lens: str = ""  # that was used
    points: int = 0
    rotation_deg: float | None = None
    centre_percent: float | None = None
    focal_percent: float | None = None
    rotation_claim_deg: float | None = None
    centre_claim_percent: float | None = None
    focal_claim_percent: float | None = None

    @property
    def over_bound(self) -> float:
        """The largest error over its bound; infinite where there is no camera to find."""
        if not self.pose:
            return np.inf
        errors = self.rotation_deg, self.centre_percent, self.focal_percent
        bounds = self.rotation_claim_deg, self.centre_claim_percent, self.focal_claim_percent
        over = [e / max(b or 0.0, 1e-9) for e, b in zip(errors, bounds, strict=True) if e is not None and e > 1e-6]
        return max(over, default=0.0)

    @property
    def wrong(self) -> bool:
        return self.outcome == "placed" and self.over_bound > WRONG


def trials(scene: EvaluationScene, landmarks: Landmarks, names: Sequence[str], told: Sequence[str]) -> Iterator[Trial]:
    """Every warp of each of the held-out images `names`."""
    true = np.stack([scene.cameras[name].T_world_camera for name in landmarks.names])
    to_scene = align_cameras(true, landmarks.Ts_world_camera)
    for number, name in enumerate(names):
        image, camera = scene.image(name), scene.cameras[name]
        K = camera.K_for(image.shape[1], image.shape[0])
        truth = to_scene.camera(camera.T_world_camera)
        for warp, make in WARPS.items():
            query = make(image, K, number)
            for source in told if warp in TOLD_WARPS else [""]:
                begun = time.process_time()
                found = localize_image(landmarks, query.image, _stated(K, query, source))
                seconds = time.process_time() - begun
                yield _trial((scene.name, name, warp, source), found, query, truth, landmarks.unit, seconds)


def _stated(K: Array, query: Query, source: str) -> Intrinsics | None:
    height, width = query.image.shape[:2]
    return Intrinsics(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], source) if source else None


def _trial(
    what: tuple[str, str, str, str],
    found: Located | NotLocated,
    query: Query,
    truth: Array,
    unit: float,
    seconds: float,
) -> Trial:
    if not isinstance(found, Located):
        return Trial(*what, outcome(found), seconds, not query.mirrored)
    focal = None
    if query.K is not None:
        focal = 100.0 * max(abs(np.log(np.diag(found.K)[:2] / np.diag(query.K)[:2])).tolist())
    return Trial(
        *what,
        "placed",
        seconds,
        not query.mirrored,
        getattr(found, "lens", ""),
        **errors_of(found, truth, unit),
        focal_percent=focal,
        focal_claim_percent=found.claim.focal_percent,
    )


def summary(found: Sequence[Trial]) -> dict[str, object]:
    """What docs/measurement.md prints."""
    clean = {(t.scene, t.image): t for t in found if t.warp == CLEAN and not t.told}
    findable = {key for key, trial in clean.items() if trial.outcome == "placed"}
    bar = [t for t in found if t.warp in BAR and not t.told]
    zoomed = [t for t in bar if t.warp.startswith("zoom")]
    there = [t for t in zoomed if (t.scene, t.image) in findable]
    others = [t for t in found if (t.warp not in BAR or t.told) and (t.warp, t.told) != (CLEAN, "")]
    placed = [t for t in found if t.outcome == "placed" and t.pose]
    kinds = dict.fromkeys((t.warp, t.told) for t in found)
    return {
        "queries": len(bar),
        "wrong": sum(t.wrong for t in bar),
        "zoomed": len(zoomed),
        "zoomed_placed": sum(t.outcome == "placed" for t in zoomed),
        "zoomed_findable": len(there),
        "zoomed_findable_placed": sum(t.outcome == "placed" for t in there),
        "clean": len(clean),
        "clean_placed": len(findable),
        "clean_wrong": sum(t.wrong for t in clean.values()),
        "others": len(others),
        "others_wrong": sum(t.wrong for t in others),
        "within": {
            kind: sum((getattr(t, error) or 0.0) <= (getattr(t, bound) or 0.0) + 1e-6 for t in placed) / len(placed)
            for kind, error, bound in (
                ("rotation", "rotation_deg", "rotation_claim_deg"),
                ("centre", "centre_percent", "centre_claim_percent"),
                ("focal", "focal_percent", "focal_claim_percent"),
            )
            if placed
        },
        "seconds_median": float(np.median([t.seconds for t in found])),
        "kinds": {f"{warp} {told}".strip(): _kind([t for t in found if (t.warp, t.told) == (warp, told)])
                  for warp, told in kinds},
    }  # fmt: skip


def _kind(found: Sequence[Trial]) -> dict[str, float | int]:
    placed = [t for t in found if t.outcome == "placed"]
    counts: dict[str, float | int] = {
        "queries": len(found),
        "placed": len(placed),
        "wrong": sum(t.wrong for t in found),
    }
    if not placed or not placed[0].pose:
        return counts
    bounds = [(t.rotation_claim_deg or 0.0, t.centre_claim_percent or 0.0) for t in placed]
    rotation, centre = np.median(bounds, axis=0).tolist()
    return {
        **counts,
        "rotation_bound": rotation,
        "centre_bound": centre,
        "over_bound_most": float(max(t.over_bound for t in placed)),
    }


def landmarks_of(scene: EvaluationScene, folder: Path, views: int, cache: Path | None) -> Landmarks | None:
    """The landmarks of the scene's training images through their file; those in `cache`, where it has some."""
    kept = None if cache is None else cache / f"{scene.name}_{views}.npz"
    if kept is not None and kept.is_file():
        return decode_landmarks(kept.read_bytes())
    estimate = estimated(scene, load_split(folder, list(scene.paths), views).train, preset("preview"))
    if estimate.landmarks is None:
        return None
    data = encode_landmarks(estimate.landmarks)
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(data)
    return decode_landmarks(data)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", help="default: five on which thresholds were chosen, and five others")
    parser.add_argument("--images", type=int, default=5, help="held-out images of each scene")
    parser.add_argument("--told", action="store_true", help="also with the lens stated")
    parser.add_argument("--shared", type=Path, default=Path("../shared"), help="folder with scenes/")
    parser.add_argument("--cache", type=Path, help="folder that keeps the scenes' landmarks")
    parser.add_argument("--join", type=Path, nargs="+", help="join the files of runs of some scenes each; run nothing")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    if args.join is not None:
        runs = [json.loads(path.read_text()) for path in args.join]
        joined = [Trial(**trial) for run in runs for trial in run["trials"]]
        _write(args.out, joined, "; ".join(run["command"] for run in runs), runs[0]["commit"])
        return
    cv2.setNumThreads(1)
    set_threads(1)
    command, commit = shlex.join(["python", "-m", "tests.bench", "query_lenses", *sys.argv[1:]]), head_commit()
    views = CHOSEN_ON | LEFT_OUT
    found: list[Trial] = []
    for name in args.scenes or views:
        folder = args.shared / "scenes" / name
        scene = load_scene(folder)
        landmarks = landmarks_of(scene, folder, views[name], args.cache)
        if landmarks is None:
            print(name, "is refused")
            continue
        names = load_split(folder, list(scene.paths), views[name]).test
        chosen = [names[i] for i in np.linspace(0, len(names) - 1, min(args.images, len(names))).round().astype(int)]
        found += trials(scene, landmarks, chosen, ("", "exif", "given") if args.told else ("",))
        _write(args.out, found, command, commit)
        print(name, json.dumps(summary([t for t in found if t.scene == name])), flush=True)
    print(json.dumps(summary(found)))


def _write(path: Path, found: Sequence[Trial], command: str, commit: str) -> None:
    halves = {
        "all": found,
        "chosen_on": [t for t in found if t.scene in CHOSEN_ON],
        "left_out": [t for t in found if t.scene in LEFT_OUT],
    }
    summaries = {half: summary(part) for half, part in halves.items() if part}
    rows = [asdict(trial) for trial in found]
    path.write_text(
        json.dumps({"command": command, "commit": commit, "summary": summaries, "trials": rows}, indent=1) + "\n"
    )


if __name__ == "__main__":
    main()
