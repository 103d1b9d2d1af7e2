"""What things that move cost: a thing pasted elsewhere over every photograph, as it is, and with masks.

    python -m tests.bench movers --scenes shared/scenes --out movers.json

The thing is an ellipse of the built-in capture, of one look and another place in each photograph. Held-out photographs
have none. They are scored whole, and by how many photographs show a pixel beside the thing (`regions.py`): what the
thing hides in all of them can only be guessed. The scene of the photographs as they are is scored on the same pixels.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from splatnode.capture.frame import Frame
from splatnode.capture.masks import apply_mask
from splatnode.extras.evaluate.protocol import PerceptualNetworks, Settings
from splatnode.extras.evaluate.regions import Counts, compute_surfaces, count_visibility_by_name
from splatnode.recon.config import preset
from splatnode.recon.keyframes import resize_mask
from splatnode.recon.pipeline import run
from splatnode.recon.result.snapshot import Snapshot
from tests.bench.quality.held_out import Case, Folders, Scoring, load_case
from tests.support.moving import look_of, pasted

SCENES = ("fountain_p11", "llff_fern", "fox")
SHARES = (0.05, 0.15, 0.30)  # of every photograph
STEPS = 60  # of the search for a held-out photograph's camera


@dataclass(frozen=True)
class Result:
    scene: str
    views: int
    share: float  # of every photograph that the thing covers
    kind: str  # "without": the photographs as they are, scored as those with the thing; "masks": given; "found"
    verdict: str
    psnr: float | None  # dB, mean over the held-out photographs
    psnr_two: float | None  # dB, of the pixels that two photographs show beside the thing
    two_pct: float | None  # their share of all pixels
    rotation_error_deg: float | None
    centre_error_pct: float | None
    num_gaussians: int | None
    seconds: float


@dataclass(frozen=True, eq=False)
class _Made:
    kind: str
    snapshot: Snapshot
    seconds: float


def _made(kind: str, frames: Sequence[Frame]) -> _Made:
    began_s = time.monotonic()
    snapshot = run(frames, preset("balanced"))
    return _Made(kind, snapshot, round(time.monotonic() - began_s, 1))


def _scored(case: Case, made: _Made, share: float, shown: Mapping[str, Counts]) -> Result:
    scoring = Scoring(PerceptualNetworks(None, None), Settings(alignment_steps=STEPS))
    scored = case.score(made.snapshot, "balanced", scoring, shown)
    two = scored.regions.get("two")
    seen = (None, None) if two is None else (two.psnr, two.share_pct)
    errors = scored.rotation_error_deg, scored.centre_error_pct
    verdict, num = scored.verdict, scored.num_gaussians
    of_case = case.scene.name, len(case.split.train), share
    return Result(*of_case, made.kind, verdict, scored.psnr, *seen, *errors, num, made.seconds)


def results(case: Case) -> Iterable[Result]:
    """For each share: of the photographs as they are, then with the thing, with masks and without."""
    frames, look = case.scene.frames(case.split.train), look_of(0)
    seen = compute_surfaces(case.scene, Settings().longer_side)
    clean = _made("without", frames)
    for share in SHARES:
        moved = [pasted(frame, share, seed, look) for seed, frame in enumerate(frames)]
        training = [
            replace(seen[frame.name], used=resize_mask(mask, *seen[frame.name].depth.shape))
            for frame, mask in moved
            if frame.name in seen
        ]
        shown = count_visibility_by_name(case.split.test, seen, training)
        yield _scored(case, clean, share, shown)
        given = [kept for frame, mask in moved if isinstance(kept := apply_mask(frame, mask), Frame)]
        yield _scored(case, _made("masks", given), share, shown)
        yield _scored(case, _made("found", [frame for frame, _ in moved]), share, shown)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench movers", description=__doc__)
    parser.add_argument("--scenes", type=Path, required=True, help="folder of the scenes")
    parser.add_argument("--of", nargs="+", default=list(SCENES), metavar="SCENE")
    parser.add_argument("--out", type=Path, required=True, help="JSON, written after each reconstruction")
    args = parser.parse_args()
    found: list[Result] = []
    for name in args.of:
        for result in results(load_case(f"{name}:6", Folders(args.scenes, args.out.parent))):
            found.append(result)
            args.out.write_text(json.dumps({"results": [asdict(each) for each in found]}, indent=1) + "\n")
            print(result, flush=True)
