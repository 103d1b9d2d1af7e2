"""Rooms of which one photograph shows plain walls alone: `python -m tests.bench plain_view --out FILE`.

Six photographs on a hand-held way, their lens told, with depth images of a simulated OAK. Five show patterns beside
plain walls; one, in the middle or at an end of the way, is turned to the plain walls, boxes and floor. It has nothing
to match, and is left out without depth. A camera is wrong where it is beyond 2.5 times its bound, as in `plain_rooms`.
What --out holds is not run again.
"""

from __future__ import annotations

import argparse
import json
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path

from splatnode.capture.process.terminal import say
from splatnode.recon.config import preset
from splatnode.recon.pipeline import estimate_frames
from splatnode.recon.threads import Clock
from tests.bench.quality.plain_rooms import VIEWS, compare_in_metres, is_far_beyond
from tests.support.depth_camera import DepthCamera
from tests.support.plain_rooms import make_room_with_plain_view, photograph

PLACES = (3, 0, 5)  # of the plain view along the way, room by room


@dataclass(frozen=True)
class Row:
    """One room. Errors are the largest of its cameras; None where depth placed none."""

    room: int
    plain_view: int
    verdict: str
    cameras: int
    is_placed: bool  # the plain view
    rotation_deg: float | None
    centre_m: float | None
    rotation_over_bound: float | None
    centre_over_bound: float | None
    unit_error: float | None

    @property
    def is_wrong(self) -> bool:
        """Whether a camera is far beyond its bound."""
        return is_far_beyond(self.rotation_over_bound, self.centre_over_bound)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.add_argument("--rooms", type=int, default=50)
    args = parser.parse_args()
    rows = [Row(**row) for row in json.loads(args.out.read_text())["rows"]] if args.out.exists() else []
    for seed in range(len(rows), args.rooms):
        rows.append(measure(seed))
        say(json.dumps(asdict(rows[-1])))
        summary = {
            "rooms": len(rows),
            "five_or_more": sum(row.cameras >= VIEWS - 1 for row in rows),
            "plain_views_placed": sum(row.is_placed for row in rows),
            "wrong": sum(row.is_wrong for row in rows),
            "largest_centre_m": max((row.centre_m for row in rows if row.centre_m is not None), default=None),
            "largest_over_bound": max(
                (max(row.rotation_over_bound or 0, row.centre_over_bound or 0) for row in rows), default=None
            ),
        }
        command = shlex.join(["python", "-m", "tests.bench", "plain_view", f"--rooms={len(rows)}"])
        content = {"command": command, "summary": summary, "rows": list(map(asdict, rows))}
        args.out.write_text(json.dumps(content, indent=1) + "\n")


def measure(seed: int) -> Row:
    """Reconstructs a room's cameras, and compares them with the true ones where depth placed one."""
    plain = PLACES[seed % len(PLACES)]
    room = make_room_with_plain_view(seed, VIEWS, plain)
    frames = photograph(room, seed, DepthCamera(seed=seed))
    estimate, _ = estimate_frames(frames, preset("fast"), Clock())
    names = estimate.publishable_camera_names
    told = seed, plain, estimate.verdict.code.value, len(names), frames[plain].name in names
    if estimate.prior_world is None or not estimate.publishable:
        return Row(*told, None, None, None, None, None)
    beside = 1 if plain == 0 and frames[plain].name in names else 0  # a camera that images place
    return Row(*told, *compare_in_metres(room, estimate, beside)[1:6])


if __name__ == "__main__":
    main()
