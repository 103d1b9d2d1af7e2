"""report.json: what happened in a reconstruction, for people and for programs."""

from __future__ import annotations

import math
import platform
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

from splatnode.recon.result.bounds import find_widest
from splatnode.recon.result.export.cameras import make_camera_dict
from splatnode.recon.result.export.formats.ply import compute_ply_bytes
from splatnode.recon.result.export.prepare import sanitize_gaussians
from splatnode.recon.result.snapshot import Snapshot

_PACKAGES = ("splatnode", "numpy", "torch", "opencv-contrib-python-headless", "pycolmap", "poselib")


def build_report(snapshot: Snapshot, *, seed: int, preset: str, peak_rss_mb: float | None) -> dict[str, object]:
    """The report of `snapshot`, ready for `json.dumps`; a value that was not measured is None.

    `scene_bytes` is the size of scene.ply, and `num_gaussians` what it holds, where the verdict lets it be published.
    """
    gaussians = sanitize_gaussians(snapshot.gaussians)
    verdict = snapshot.verdict
    worst = find_widest(camera.bounds for camera in snapshot.cameras if camera.bounds is not None)
    share = snapshot.consistent_depth
    stages = {stage: seconds for stage, seconds in snapshot.seconds.items() if stage != "total"}
    return {
        **snapshot.scale.record(),
        "up": None if snapshot.up is None else asdict(snapshot.up),
        "verdict": {
            "code": verdict.code.value,
            "message": verdict.message,
            "advice": verdict.advice,
            "frames": list(verdict.frames),
            "publishable": verdict.publishable,
            # Whether a later report of the same photographs may say otherwise, or show them better.
            "provisional": verdict.provisional or not snapshot.final,
        },
        "bounds": None if worst is None else asdict(worst),
        "consistent_depth": None if share is None else round(share, 4),
        "evidence": snapshot.evidence,
        "seconds": {**stages, "total": snapshot.seconds.get("total", sum(stages.values()))},
        "peak_rss_mb": peak_rss_mb,
        "num_gaussians": len(gaussians),
        "scene_bytes": compute_ply_bytes(len(gaussians), gaussians.sh.shape[1], snapshot.scale)
        if verdict.publishable
        else 0,
        "iterations": snapshot.iterations,
        "budget": [dict(hit) for hit in snapshot.budget],
        "served_by": dict(snapshot.served_by),
        "cameras": [make_camera_dict(camera) for camera in snapshot.cameras],
        "frames_used": [camera.name for camera in snapshot.cameras],
        "frames_dropped": [{"name": frame.name, "reason": frame.reason} for frame in snapshot.dropped],
        "masked": {name: round(share, 4) for name, share in snapshot.masked.items()},
        "moving": {name: round(share, 4) for name, share in snapshot.moving.items()},
        "gains": {name: [round(gain, 4) for gain in gains] for name, gains in snapshot.gains.items()},
        "vignetting": {name: round(1.0 - math.exp(-falloff), 4) for name, falloff in snapshot.falloffs.items()},
        "seed": seed,
        "preset": preset,
        "versions": collect_versions(),
    }


def collect_versions() -> dict[str, str | None]:
    """Collects the versions of Python, the platform and the main packages (None: not installed)."""
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        **{package: _version(package) for package in _PACKAGES},
    }


def peak_rss_mb() -> float | None:
    """The most memory that this process has held, in MB (10^6 bytes); None where the system does not tell.

    /proc is asked first: getrusage also counts what the parent held when it started this process.
    """
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        return None
    unit = 1 if platform.system() == "Darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
