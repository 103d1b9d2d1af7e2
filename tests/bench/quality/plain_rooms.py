"""Rooms where photographs show nothing to match, with a depth camera: `python -m tests.bench plain_rooms --out FILE`.

Each room is reconstructed from six photographs whose lens is told, alone and with depth images of a simulated OAK. A
camera is wrong where it is beyond 2.5 times its 95 % bound, in metres, in the frame of the first camera that is placed.
Rooms of `noisy` have twice the noise that is told; in those of `shifted` depth lies 4 pixels (of 640) beside the
photograph, and in those of `lens` the focal length that is told is 10 % too long. What --out holds is not run again.
"""

from __future__ import annotations

import argparse
import json
import shlex
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Frame
from splatnode.capture.process.terminal import say
from splatnode.recon.config import preset
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.pipeline import estimate_frames
from splatnode.recon.threads import Clock
from tests.support.depth_camera import DepthCamera
from tests.support.plain_rooms import Room, make_room, photograph

VIEWS = 6
KINDS = {
    "good": DepthCamera(),
    "noisy": DepthCamera(noise_px=0.5),
    "shifted": DepthCamera(shift_px=(4.0, 0.0)),
    "lens": DepthCamera(),
}
_LONGER = 1.1  # focal length told over the true one, of `lens`
_WRONG = 2.5  # times a bound


def is_far_beyond(*over_bounds: float | None) -> bool:
    """Whether one of the errors, over their bounds, is that of a wrong camera; None is no error."""
    return max(each or 0.0 for each in over_bounds) > _WRONG


@dataclass(frozen=True)
class Row:
    """One room. Errors are the largest of its cameras; None where there is no answer."""

    room: int
    kind: str
    alone: str  # verdict without depth images
    verdict: str
    placed: int
    rotation_deg: float | None
    centre_m: float | None
    rotation_over_bound: float | None
    centre_over_bound: float | None
    unit_error: float | None  # of metres a unit, as a share: by the distances between cameras
    unit_over_bound: float | None
    seconds: float  # of the processor, with depth images, until there is depth of each camera

    @property
    def is_wrong(self) -> bool:
        """Whether a camera is far beyond its bound."""
        return is_far_beyond(self.rotation_over_bound, self.centre_over_bound)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.add_argument("--rooms", type=int, default=50, help="good ones; of each other kind there are a fifth")
    args = parser.parse_args()
    rows = [Row(**row) for row in json.loads(args.out.read_text())["rows"]] if args.out.exists() else []
    done = {(row.room, row.kind) for row in rows}
    for seed in range(args.rooms):
        for kind in KINDS:
            if (seed, kind) not in done and (kind == "good" or seed % 5 == 0):
                rows.append(measure(seed, kind))
                say(json.dumps(asdict(rows[-1])))
                command = shlex.join(["python", "-m", "tests.bench", "plain_rooms", f"--rooms={args.rooms}"])
                content = {"command": command, "summary": summarize(rows), "rows": list(map(asdict, rows))}
                args.out.write_text(json.dumps(content, indent=1) + "\n")
    say(json.dumps(summarize(rows)))


def measure(seed: int, kind: str) -> Row:
    """Reconstructs a room's cameras, alone and with depth images, and compares these with the true ones."""
    room = make_room(seed, VIEWS)
    frames = photograph(room, seed, replace(KINDS[kind], seed=seed))
    if kind == "lens":
        frames = [_lengthen(frame) for frame in frames]
    alone, _ = estimate_frames([replace(frame, depth=None) for frame in frames], preset("fast"), Clock())
    began = time.process_time()
    estimate, _ = estimate_frames(frames, preset("fast"), Clock())
    seconds = round(time.process_time() - began, 2)
    codes = seed, kind, alone.verdict.code.value, estimate.verdict.code.value
    if estimate.prior_world is None or not estimate.verdict.publishable:
        return Row(*codes, 0, None, None, None, None, None, None, seconds)
    return Row(*codes, *compare_in_metres(room, estimate), seconds)


def _lengthen(frame: Frame) -> Frame:
    lens = frame.intrinsics
    assert lens is not None
    return replace(frame, intrinsics=replace(lens, fx=_LONGER * lens.fx, fy=_LONGER * lens.fy))


def compare_in_metres(
    room: Room, estimate: Reconstruction, beside: int = 0
) -> tuple[int, float, float, float, float, float, float]:
    """How many cameras there are, and the last six errors of a Row: those of cameras held by depth.

    The camera `beside`, in the order of the way among those that are placed, is taken to be where it is.
    """
    given, registration = estimate.prior_world, estimate.registration
    assert given is not None and registration is not None
    cameras, names = registration.cameras, estimate.graph.names
    placed = sorted(cameras, key=lambda camera: names[camera.index])
    true = {name: room.cameras[int(name[5:8])][0] for name in names}
    bounds, own, theirs, ratios = estimate.bounds, [], [], []
    here, to_first = placed[beside].T_world_camera, np.linalg.inv(true[names[placed[beside].index]])
    first = np.eye(4)
    first[:3, :3] = given.rotation @ here[:3, :3]
    first[:3, 3] = given.scale * given.rotation @ here[:3, 3] + given.translation
    for camera in placed:
        T, expected = camera.T_world_camera, first @ to_first @ true[names[camera.index]]
        centre = given.scale * given.rotation @ T[:3, 3] + given.translation
        turn = np.degrees(Rotation.from_matrix((given.rotation @ T[:3, :3]).T @ expected[:3, :3]).magnitude())
        off, bound = float(np.linalg.norm(centre - expected[:3, 3])), bounds[names[camera.index]]
        own.append(centre)
        theirs.append(expected[:3, 3])
        ratios.append((float(turn), off, float(turn) / bound.rotation_deg, off / (given.scale * bound.centre)))
    pairs = np.triu_indices(len(placed), 1)
    apart = [np.linalg.norm((np.array(each)[:, None] - np.array(each)[None])[pairs], axis=-1) for each in (own, theirs)]
    unit_error = float(np.sum(apart[0] * apart[1]) / np.sum(apart[1] ** 2) - 1.0)
    worst = np.array(ratios).max(0).tolist()
    return (len(placed), *worst, unit_error, abs(unit_error) / (1.96 * given.scale_sigma))


def summarize(rows: Sequence[Row]) -> dict[str, object]:
    """Counts by kind."""
    found = {}
    for kind in KINDS:
        mine = [row for row in rows if row.kind == kind]
        refused = [row for row in mine if not row.alone.startswith("OK")]
        answered = [row for row in refused if row.verdict.startswith("OK")]
        errors = [abs(row.unit_error) for row in mine if row.unit_error is not None]
        found[kind] = {
            "rooms": len(mine),
            "refused_alone": len(refused),
            "answered_with_depth": len(answered),
            "cameras_placed": sum(row.placed for row in answered),
            "wrong": sum(row.is_wrong for row in mine),
            "beyond_bound": sum(
                max(row.rotation_over_bound or 0, row.centre_over_bound or 0) > 1 for row in mine if row.placed
            ),
            "largest_unit_error": max(errors, default=None),
            "unit_beyond_bound": sum((row.unit_over_bound or 0) > 1 for row in mine),
            "median_seconds": float(np.median([row.seconds for row in answered])) if answered else None,
        }
    return found


if __name__ == "__main__":
    main()
