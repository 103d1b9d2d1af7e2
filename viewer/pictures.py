"""Pictures without a window: a PNG series, an MP4 turntable, and a picture that is kept up to date."""

from __future__ import annotations

import errno
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.image_file import encode_png
from splatnode.capture.process.terminal import ProgressStep, Tell, ignore_progress, report_items
from splatnode.recon.result.export import ResultWriteError, write_beside, write_files
from splatnode.recon.result.export.result import LIVE_PICTURE
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.viewer import text
from splatnode.viewer.analysis import Analysis, analyse
from splatnode.viewer.paint import add_caption, blend_image, paint
from splatnode.viewer.shapes import Ground, Shapes, ground, ground_lines, legend, merge_shapes, shapes
from splatnode.viewer.sources import Source
from splatnode.viewer.state import Moment, ViewerState
from splatnode.viewer.viewpoint import Viewpoint, look_at, move_to_camera, overview

# A tour that swings around the scene, inside the arc from which it was photographed and above the ground.

Array = npt.NDArray[np.float64]

_WIDEST = math.radians(60.0), math.radians(20.0)  # to either side, and up and down
_ALONE = math.radians(6.0), math.radians(3.0)  # around a single camera, or where none is known
_CLEARANCE = 0.02  # of the distance to the scene: no lower above the ground


@dataclass(frozen=True, eq=False)
class Arc:
    """The arc of the cameras, as seen from the pivot: angles in radians around `up`, and above the level."""

    azimuths: tuple[float, float]  # least and greatest, from the direction of the cameras' mean
    elevations: tuple[float, float]
    distance: float  # the median


def turntable_views(moment: Moment, frames: int) -> list[Viewpoint]:
    """A closed tour, `frames` long, around the pivot: an ellipse within the arc that was seen, and above the ground.

    A full circle would mostly show what no photograph shows.
    """
    start, cameras, below = overview(moment), moment.snapshot.cameras, ground(moment)
    level = _mean_level_direction(cameras, start) if cameras else None
    if level is None or len(cameras) < 2:
        width, height, level = *_ALONE, (start.T_world_camera[:3, 3] - start.pivot) / start.distance
        middle, distance = (0.0, math.asin(float(np.clip(level @ start.up, -1.0, 1.0)))), start.distance
        level = _project_to_level(level, start.up)
    else:
        arc = compute_arc(cameras, start.pivot, start.up)
        (left, right), (low, high), distance = arc.azimuths, arc.elevations, arc.distance
        width, height = min((right - left) / 2.0, _WIDEST[0]), min((high - low) / 2.0, _WIDEST[1])
        middle = (left + right) / 2.0, (low + high) / 2.0
    angles = 2.0 * np.pi * np.arange(frames) / frames
    return [
        _view(start, level, middle[0] + width * math.sin(a), middle[1] + height * math.cos(a), distance, below)
        for a in angles
    ]


def compute_arc(cameras: tuple[CameraEstimate, ...], pivot: Array, up: Array) -> Arc:
    """The arc of at least one camera's centre around the `pivot` (3,)."""
    offsets = np.array([camera.T_world_camera[:3, 3] for camera in cameras]) - pivot
    distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    level = _project_to_level(offsets.mean(0), up)
    azimuths = np.arctan2(offsets @ np.cross(up, level), offsets @ level)
    elevations = np.arcsin(np.clip(offsets @ up / distances, -1.0, 1.0))
    return Arc(
        (float(azimuths.min()), float(azimuths.max())),
        (float(elevations.min()), float(elevations.max())),
        float(np.median(distances)),
    )


def _mean_level_direction(cameras: tuple[CameraEstimate, ...], start: Viewpoint) -> Array:
    """(3,) the level direction from the pivot to the middle of the cameras."""
    centres = np.array([camera.T_world_camera[:3, 3] for camera in cameras])
    return _project_to_level(centres.mean(0) - start.pivot, start.up)


def _project_to_level(direction: Array, up: Array) -> Array:
    flat = direction - (direction @ up) * up
    if np.linalg.norm(flat) < 1e-9:  # straight above: any level direction will do
        flat = np.cross(up, np.roll(up, 1))
    return flat / max(float(np.linalg.norm(flat)), 1e-12)


def _view(
    start: Viewpoint, level: Array, azimuth: float, elevation: float, distance: float, below: Ground | None
) -> Viewpoint:
    """At these angles around the pivot; as much higher as keeps it above the ground."""
    side = np.cross(start.up, level)
    outwards = math.cos(elevation) * (math.cos(azimuth) * level + math.sin(azimuth) * side)
    centre = start.pivot + distance * (outwards + math.sin(elevation) * start.up)
    if below is not None:
        centre = centre + max(_CLEARANCE * distance - below.height(centre), 0.0) * start.up
    return replace(start, T_world_camera=look_at(centre, start.pivot, start.up), distance=distance)


Image = npt.NDArray[np.uint8]

FRAMES_PER_S = 25
_DRAWING = "drawing"
_WAIT_S = 0.1
_PATIENCE_S = 1.0  # without a word


def write_series(
    moment: Moment, folder: Path, width: int, height: int, frames: int, *, of: Path, tell: Tell = ignore_progress
) -> Path:
    """overview.png with all there is to say, a picture from each camera beside its photograph, and a turntable.

    `of` is the result that they show: what lies in its folder belongs to it.
    `tell` hears how many are drawn. Raises ResultWriteError where they cannot be written.
    """
    total = 1 + len(moment.snapshot.cameras) + frames
    tell(ProgressStep(_DRAWING, 0, total, "picture"))
    files = {"overview.png": encode_png(overview_picture(analyse(moment), width, height))}
    view = overview(moment)
    for camera in moment.snapshot.cameras:
        tell(ProgressStep(_DRAWING, len(files), total, "picture"))
        here = move_to_camera(view, camera)
        image = paint(moment.snapshot.gaussians, Shapes((), ()), here, ViewerState(), width, height)
        photograph = moment.snapshot.images.get(camera.name)
        if photograph is not None:
            image = np.hstack([blend_image(image, photograph, camera, here.K(width, height), 1.0), image])
        files[f"camera_{camera.frame_id:03d}.png"] = encode_png(image)
    for number, image in enumerate(turntable(moment, width, height, frames)):
        files[f"turntable_{number:03d}.png"] = encode_png(image)
        tell(ProgressStep(_DRAWING, len(files), total, "picture"))
    write_beside(folder, files, of)
    return folder


def write_movie(
    moment: Moment, path: Path, width: int, height: int, frames: int, *, of: Path, tell: Tell = ignore_progress
) -> Path:
    """The turntable of the result `of` as an MP4; `tell` hears how many of its pictures are drawn.

    Raises ResultWriteError; RuntimeError where this OpenCV cannot write MP4.
    """
    size = width - width % 2, height - height % 2  # the encoding has half the resolution in colour
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "turntable.mp4"
        writer = cv2.VideoWriter(str(draft), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_PER_S, size)
        if not writer.isOpened():
            raise RuntimeError("this OpenCV cannot write MP4; use --headless for a PNG series")
        for image in report_items(turntable(moment, *size, frames), tell, _DRAWING, frames, "picture"):
            writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        writer.release()
        if round(cv2.VideoCapture(str(draft)).get(cv2.CAP_PROP_FRAME_COUNT)) != frames:  # the writer tells nothing
            where = tempfile.gettempdir()
            raise ResultWriteError(
                errno.ENOSPC, f"the movie does not fit into {where}: free some space or name another folder by TMPDIR"
            )
        write_beside(path, {"": draft.read_bytes()}, of)
    return path


def turntable(moment: Moment, width: int, height: int, frames: int) -> Iterator[Image]:
    """The Gaussians alone, from a closed tour around them."""
    for view in turntable_views(moment, frames):
        yield paint(moment.snapshot.gaussians, Shapes((), ()), view, ViewerState(), width, height)


def overview_picture(analysis: Analysis, width: int, height: int) -> Image:
    """The whole scene with cameras, photographs, path and advice, and below it what the panel of a window says."""
    moment, state = analysis.moment, ViewerState()
    view: Viewpoint = overview(moment, analysis.advice.arrow or ())
    shown = merge_shapes(
        Shapes(ground_lines(ground(moment)), ()),
        shapes(moment, state, analysis.advice),
        legend(view, width, height, moment.snapshot.scale),
    )
    image = paint(moment.snapshot.gaussians, shown, view, state, width, height)
    said = [*text.verdict_lines(moment), f"Next view: {text.advice_line(analysis.advice, moment)}"]
    said += [
        *text.bounds_lines(moment),
        *text.depth_lines(moment),
        *text.place_lines(moment),
        *text.count_lines(moment),
        *text.rejection_lines(moment),
    ]
    return add_caption(image, said)


def update_picture(
    source: Source, folder: Path, width: int, height: int, *, until_final: bool, say: Callable[[str], None]
) -> None:
    """Writes live.png anew for every moment that comes, the newest first, for ever or until a snapshot is final.

    A moment that comes while another one is painted replaces those that wait: nothing piles up.
    """
    for moment in _wait_for_moments(source, say):
        started = time.perf_counter()
        picture = overview_picture(analyse(moment), width, height)
        write_files(folder, {LIVE_PICTURE: encode_png(picture)})
        line = text.verdict_lines(moment)[0]
        say(f"{folder / LIVE_PICTURE}: {line} ({time.perf_counter() - started:.1f} s)")
        if until_final and moment.snapshot.final:
            return


def _wait_for_moments(source: Source, say: Callable[[str], None]) -> Iterator[Moment]:
    """Those that come; says what it waits for before the first one, after a second and when the node is heard of."""
    began_s, came, told = time.monotonic(), False, ""
    while True:
        moment = source.take()
        if moment is not None:
            came = True
            yield moment
        elif source.age_s is None:
            return
        else:
            line = text.waiting_line(source.age_s if source.age_s == math.inf else 0.0)
            if not came and line != told and time.monotonic() - began_s >= _PATIENCE_S:
                told = line
                say(line)
            time.sleep(_WAIT_S)
