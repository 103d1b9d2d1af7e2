"""What things that move cost: a thing pasted elsewhere over every photograph, as it is, and with masks.

    python -m tests.bench movers --scenes shared/scenes --out movers.json

The thing is an ellipse of the built-in capture, of one look and another place in each photograph. Held-out photographs
have none, and are scored whole: a place that the thing hides in the photographs beside them counts, too.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from splatnode.capture.frame import Frame
from splatnode.capture.masks import masked
from splatnode.recon.config import preset
from splatnode.recon.evaluate.perceptual import Networks
from splatnode.recon.evaluate.protocol import Settings
from splatnode.recon.offline import run
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
    masks: bool
    verdict: str
    psnr: float | None  # dB, mean over the held-out photographs
    rotation_error_deg: float | None
    centre_error_pct: float | None
    num_gaussians: int | None
    seconds: float


def measured(case: Case, frames: Sequence[Frame], share: float, masks: bool) -> Result:
    """One reconstruction, scored."""
    began_s = time.monotonic()
    snapshot = run(frames, preset("balanced"))
    seconds = time.monotonic() - began_s
    scored = case.score(snapshot, "balanced", Scoring(Networks(None, None), Settings(alignment_steps=STEPS)))
    errors = scored.rotation_error_deg, scored.centre_error_pct
    verdict, num = scored.verdict, scored.num_gaussians
    return Result(case.scene.name, len(frames), share, masks, verdict, scored.psnr, *errors, num, round(seconds, 1))


def results(case: Case) -> Iterable[Result]:
    """Of the photographs as they are, then with the thing, without and with masks."""
    frames, look = case.scene.frames(case.split.train), look_of(0)
    yield measured(case, frames, 0.0, False)
    for share in SHARES:
        moved = [pasted(frame, share, seed, look) for seed, frame in enumerate(frames)]
        for masks in (True, False):
            kept = [masked(frame, mask) if masks else frame for frame, mask in moved]
            yield measured(case, [frame for frame in kept if isinstance(frame, Frame)], share, masks)


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
