"""report.json: what happened in a reconstruction, for people and for programs; and what a command tells of it."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.image_file import encode_png
from splatnode.capture.process.terminal import say
from splatnode.capture.rig import format_rig
from splatnode.recon.result.export import write_result
from splatnode.recon.result.export.formats.ply import compute_ply_bytes
from splatnode.recon.result.export.limits import sanitize_gaussians
from splatnode.recon.result.export.stored import SOURCES, encode_sources, make_camera_dict
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import (
    CameraEstimate,
    GaussianArrays,
    Snapshot,
    describe_moving,
    format_widest_bounds,
)
from splatnode.recon.result.stored_snapshot import DEPTHS, LANDMARKS, encode_depths, encode_landmarks
from splatnode.recon.result.verdict import FIRST_CAMERA, find_widest

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
        "given_poses": _list_given_poses(snapshot.cameras),
        "frames_used": [camera.name for camera in snapshot.cameras],
        "frames_dropped": [
            *({"name": frame.name, "reason": frame.reason} for frame in snapshot.dropped),
            *({"name": name, "reason": _UNPLACED} for name in _list_unplaced(snapshot)),
        ],
        "masked": {name: round(share, 4) for name, share in snapshot.masked.items()},
        "moving": {name: round(share, 4) for name, share in snapshot.moving.items()},
        "gains": {name: [round(gain, 4) for gain in gains] for name, gains in snapshot.gains.items()},
        "gain_sigmas": {name: [round(each, 4) for each in sigmas] for name, sigmas in snapshot.gain_sigmas.items()},
        "vignetting": {name: round(1.0 - math.exp(-falloff), 4) for name, falloff in snapshot.falloffs.items()},
        **({"depth": [check.record() for check in snapshot.depth_checks]} if snapshot.depth_checks else {}),
        "seed": seed,
        "preset": preset,
        "versions": collect_versions(),
    }


def _list_given_poses(cameras: Iterable[CameraEstimate]) -> list[dict[str, object]]:
    """The poses that were given, and how far they are from the estimated ones; the farthest first."""
    known = [(camera, camera.given, camera.pose_residual) for camera in cameras]
    rows = [
        (residual, camera, given) for camera, given, residual in known if given is not None and residual is not None
    ]
    return [
        {
            "name": camera.name,
            "residual_m": residual[0],
            "residual_deg": residual[1],
            "sigma_m": given.sigma_m,
            "sigma_deg": given.sigma_deg,
        }
        for residual, camera, given in sorted(rows, key=lambda row: -row[0][0])
    ]


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


# preview.png: what the cameras saw beside what the Gaussians show. It needs no torch.

Image = npt.NDArray[np.uint8]


def render_rgb(
    gaussians: GaussianArrays,
    T_world_camera: npt.NDArray[np.float64],
    K: npt.NDArray[np.float64],
    width: int,
    height: int,
) -> npt.NDArray[np.float32]:
    """(H, W, 3) the Gaussians' image on black, in [0, 1]."""
    return np.clip(render_arrays(gaussians, T_world_camera, K, width, height).rgb, 0.0, 1.0)


def render_camera(gaussians: GaussianArrays, camera: CameraEstimate) -> Image:
    """(H, W, 3) RGB of the Gaussians from an estimated camera."""
    rgb = render_rgb(gaussians, camera.T_world_camera, camera.K, camera.width, camera.height)
    return np.rint(rgb * 255).astype(np.uint8)


def make_contact_sheet(snapshot: Snapshot, max_views: int = 4, height: int = 240) -> bytes:
    """A PNG: photographs above, the Gaussians seen from the same cameras below; cameras from the first to the last.

    Without photographs where the snapshot does not have one of each camera.
    """
    count = len(snapshot.cameras)
    photographed = all(camera.name in snapshot.images for camera in snapshot.cameras)
    shown = np.linspace(0, count - 1, min(count, max_views)).round().astype(int)
    columns = []
    for camera in (snapshot.cameras[index] for index in shown):
        above = [snapshot.images[camera.name]] if photographed else []
        pair = [*above, render_camera(snapshot.gaussians, camera)]
        size = (round(camera.width * height / camera.height), height)
        columns.append(np.vstack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in pair]))
    return encode_png(np.hstack(columns))


# How much a result takes on the disk, before it is made.

BYTES_A_GAUSSIAN = 124  # 68 in scene.ply, 46 to 50 in colmap/points3D.txt, 4 in sources.bin
OTHER_BYTES = 2_000_000  # preview.png (1.2 MB measured at most), report and cameras
DEPTH_BYTES = 130_000  # a photograph of 512 x 384 pixels, of depth.npz, before it is packed
LANDMARK_BYTES = 310_000  # a photograph, of landmarks.npz: 2000 descriptors and their points, before they are packed
# Photographs of real scenes led to a Gaussian for 28 to 60 pixels; four times as many are allowed for.
PIXELS_A_GAUSSIAN = 8


def bound_result_bytes(sizes: Iterable[tuple[int, int]], longer_side: int, most_gaussians: int | None) -> int:
    """Bytes that the result of photographs of these `sizes` (width, height) stays below.

    `longer_side` of the modelled images is in pixels; `most_gaussians` is the limit that was set, if any.
    """
    known = list(sizes)
    pixels = sum(longer_side**2 * min(size) / max(size) for size in known)
    expected = round(pixels / PIXELS_A_GAUSSIAN)
    num_gaussians = expected if most_gaussians is None else min(expected, most_gaussians)
    return estimate_result_bytes(num_gaussians, len(known))


def estimate_result_bytes(num_gaussians: int, num_photographs: int = 0) -> int:
    """Bytes of a result folder with so many Gaussians, and with what is kept of so many photographs, rounded up."""
    return BYTES_A_GAUSSIAN * num_gaussians + (LANDMARK_BYTES + DEPTH_BYTES) * num_photographs + OTHER_BYTES


# The result folder of a snapshot, with its report and a preview.

RIG = "rig.yaml"  # in the result folder: the estimated rig


def write_result_folder(
    snapshot: Snapshot,
    out: Path,
    *,
    seed: int,
    preset_name: str,
    photographs: Mapping[str, bytes] = MappingProxyType({}),
    extra_fields: Mapping[str, object] = MappingProxyType({}),
) -> dict[str, object]:
    """Writes the result folder and returns its report, of which `extra_fields` is a part.

    `photographs` are files that a scene has beside it, by their names in the folder. Raises ResultWriteError, with what
    was there before intact.
    """
    report = build_report(snapshot, seed=seed, preset=preset_name, peak_rss_mb=peak_rss_mb()) | dict(extra_fields)
    preview = make_contact_sheet(snapshot) if snapshot.verdict.publishable else None
    source_frame = sanitize_gaussians(snapshot.gaussians).source_frame  # of those that scene.ply holds
    further = {SOURCES: encode_sources(source_frame), **photographs} if snapshot.verdict.publishable else {}
    if snapshot.verdict.publishable and snapshot.landmarks is not None:
        further[LANDMARKS] = encode_landmarks(snapshot.landmarks)
    if snapshot.verdict.publishable and snapshot.depths:
        further[DEPTHS] = encode_depths(snapshot.depths)
    if snapshot.verdict.publishable and snapshot.rig is not None:
        further[RIG] = format_rig(snapshot.rig.mounts, snapshot.scale.metric).encode()
    write_result(snapshot, out, report, preview=preview, further=further)
    return report


_UNPLACED = "it has no camera in the scene, as the verdict says"


def _list_unplaced(snapshot: Snapshot) -> list[str]:
    """The images of a published verdict that have no camera, in their order."""
    known = {each.name for each in (*snapshot.cameras, *snapshot.dropped)}
    return [name for name in snapshot.verdict.frames if name not in known] if snapshot.verdict.publishable else []


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
    further = snapshot.seconds.get("fallbacks", 0.0)
    if further >= 0.1:
        say(
            f"{further:.1f} s of {snapshot.seconds['total']:.1f} s went into more matches "
            "(--no-fallbacks leaves them out)"
        )
    say(f"results: {out}/ ({'scene.ply, cameras.json, preview.png, ' if verdict.publishable else ''}report.json)")
