"""A snapshot as rerun shows it: cameras with their photographs, Gaussians, landmarks, and the verdict as text.

The only file that imports rerun, which is an extra and takes a second to load.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from splatnode.capture.process.text import escape_text
from splatnode.recon.result.export.limits import compute_base_rgb
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Landmarks, Snapshot
from splatnode.recon.result.stored_snapshot import encode_image

rr: Any = importlib.import_module("rerun")  # by its name: where it is not installed, pyright takes this file for it

WORLD = "world"
STEP = "step"  # the timeline of a live scene: the number of the update
LIVE = f"{WORLD}/live_camera"
_APPLICATION = "splatnode"
_HIGHER_BASES = 15  # spherical harmonics of the degrees 1 to 3
_IMAGE_PLANE = 0.1  # how far before its camera a photograph is drawn, in the scene's median depths
_LANDMARK_RGB = (255, 170, 0)


class RerunRecording(Protocol):
    """The methods of rerun's RecordingStream that are used."""

    def log(self, entity_path: str, entity: object, *, static: bool = False) -> None: ...

    def set_time(self, timeline: str, *, sequence: int) -> None: ...

    def flush(self) -> None: ...


def encode_recording(snapshot: Snapshot) -> bytes:
    """The content of an .rrd file."""
    recording = rr.RecordingStream(_APPLICATION)
    stream = recording.binary_stream()
    draw(recording, snapshot)
    return stream.read() or b""


def connect_viewer(url: str) -> RerunRecording:
    """A recording whose content goes to the rerun viewer at `url`."""
    recording = rr.RecordingStream(_APPLICATION)
    recording.connect_grpc(url)
    return recording


def draw(
    recording: RerunRecording,
    snapshot: Snapshot,
    step: int | None = None,
    before: frozenset[str] = frozenset(),
) -> frozenset[str]:
    """Shows the snapshot in place of what was drawn `before`; returns the paths of what is drawn now.

    `step` is the number of an update; None: the scene holds for all times.
    """
    static = step is None
    if step is not None:
        recording.set_time(STEP, sequence=step)
    recording.log(WORLD, rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
    drawn = list(_list_contents(snapshot))
    for path, content in drawn:
        recording.log(path, content, static=static)
    now = frozenset(path for path, _ in drawn)
    for path in sorted(before - now):  # only these: rerun 0.41 loses a pinhole that is cleared and drawn at one time
        recording.log(path, rr.Clear(recursive=True))
    return now


def draw_tracked(recording: RerunRecording, camera: CameraEstimate | None, step: int) -> None:
    """The live camera from `step` on; None: it is not known where it is."""
    recording.set_time(STEP, sequence=step)
    if camera is None:
        recording.log(LIVE, rr.Clear(recursive=True))
        return
    for content in _make_camera(camera, _IMAGE_PLANE):
        recording.log(LIVE, content)


def _list_contents(snapshot: Snapshot) -> Iterator[tuple[str, object]]:
    """Lists what is drawn, each with its path."""
    plane = _IMAGE_PLANE * (snapshot.landmarks.unit if snapshot.landmarks is not None else 1.0)
    for camera in snapshot.cameras:
        path = f"{WORLD}/cameras/{rr.escape_entity_path_part(camera.name)}"
        for content in _make_camera(camera, plane):
            yield path, content
        photograph = encode_image(camera, snapshot.images)
        if photograph is not None:
            yield path, rr.EncodedImage(contents=photograph, media_type="image/jpeg")
    if len(snapshot.gaussians):
        yield f"{WORLD}/gaussians", _make_splats(snapshot.gaussians)
    if snapshot.landmarks is not None:
        yield f"{WORLD}/landmarks", _make_points(snapshot.landmarks)
    yield "verdict", rr.TextDocument(_format_text(snapshot), media_type="text/markdown")


def _make_camera(camera: CameraEstimate, plane: float) -> tuple[object, object]:
    pose = rr.Transform3D(translation=camera.T_world_camera[:3, 3], mat3x3=camera.T_world_camera[:3, :3])
    lens = rr.Pinhole(
        image_from_camera=camera.K,
        resolution=(camera.width, camera.height),
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=plane,
    )
    return pose, lens


def _make_splats(gaussians: GaussianArrays) -> object:
    alpha = np.rint(255 * gaussians.opacities).astype(np.uint8)
    colours = np.column_stack([compute_base_rgb(gaussians), alpha])
    higher = np.zeros((len(gaussians), _HIGHER_BASES, 3), np.float32)
    higher[:, : gaussians.sh.shape[1] - 1] = gaussians.sh[:, 1:]
    return rr.GaussianSplats3D(
        gaussians.means,
        scales=gaussians.scales,
        quaternions=gaussians.quats[:, [1, 2, 3, 0]],  # xyzw
        colors=colours,
        sh_coefficients=higher,
        spherical_harmonics_degree=round(gaussians.sh.shape[1] ** 0.5) - 1,
    )


def _make_points(landmarks: Landmarks) -> object:
    return rr.Points3D(landmarks.points, radii=[-2.0], colors=_LANDMARK_RGB)  # below 0: of so many pixels


def _format_text(snapshot: Snapshot) -> str:
    verdict = snapshot.verdict
    counts = f"{len(snapshot.cameras)} cameras, {len(snapshot.gaussians)} Gaussians; lengths {snapshot.scale.sentence}"
    dropped = [f"- {escape_text(frame.name)}: {frame.reason}" for frame in snapshot.dropped]
    left_out = ["Left out:", "\n".join(dropped)] if dropped else []
    frame = f"Frame: {snapshot.scale.frame.sentence}"
    lines = [f"# {verdict.code.value}", verdict.message, verdict.advice, counts, frame, *left_out]
    return "\n\n".join(line for line in lines if line)
