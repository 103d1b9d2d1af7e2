"""What a command tells of the scene that it made."""

from __future__ import annotations

from pathlib import Path

from splatnode.capture.process.terminal import say
from splatnode.recon.result.reference_frame import FIRST_CAMERA
from splatnode.recon.result.snapshot import Snapshot, describe_moving, format_widest_bounds


def print_summary(snapshot: Snapshot, out: Path) -> None:
    """Prints the verdict, what was left out, how large and how good the scene is, and where its files are."""
    verdict = snapshot.verdict
    say(f"{verdict.code.value}: {verdict.message}" + (f" {verdict.advice}" if verdict.advice else ""))
    for frame in snapshot.dropped:
        say(f"left out: {frame.name}: {frame.reason}")
    if moved := describe_moving(snapshot.moving):
        say(moved)
    for hit in snapshot.budget:
        say(hit["message"])
    if verdict.publishable:
        counts = f"{len(snapshot.gaussians)} Gaussians, {len(snapshot.cameras)} cameras"
        say(f"{snapshot.seconds['total']:.1f} s, {counts}")
        if known := format_widest_bounds(snapshot.cameras, snapshot.scale):
            say(f"how well the cameras are known: {known}")
        if snapshot.scale.source is not None:
            say(f"lengths: {snapshot.scale.sentence}")
        if snapshot.scale.frame != FIRST_CAMERA:
            say(f"frame: {snapshot.scale.frame.sentence}")
    further = snapshot.seconds.get("ladder", 0.0)
    if further >= 0.1:
        say(
            f"{further:.1f} s of {snapshot.seconds['total']:.1f} s went into more matches "
            "(--no-fallbacks leaves them out)"
        )
    say(f"results: {out}/ ({'scene.ply, cameras.json, preview.png, ' if verdict.publishable else ''}report.json)")
