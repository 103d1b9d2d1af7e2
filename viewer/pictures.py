"""Pictures without a window: a PNG series, an MP4 turntable, and a picture that is kept up to date."""

from __future__ import annotations

import errno
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.image_file import encode_png
from splatnode.capture.process.progress import ProgressStep, Tell, ignore_progress, report_items
from splatnode.recon.result.export import ResultWriteError, write_beside, write_files
from splatnode.recon.result.export.manifest import LIVE_PICTURE
from splatnode.viewer import words
from splatnode.viewer.analysis import Analysis, analyse
from splatnode.viewer.ground import ground, ground_lines
from splatnode.viewer.legend import legend
from splatnode.viewer.moment import Moment
from splatnode.viewer.paint import add_caption, blend_image, paint
from splatnode.viewer.shapes import Shapes, merge_shapes, shapes
from splatnode.viewer.sources import Source
from splatnode.viewer.state import ViewerState
from splatnode.viewer.turntable import turntable_views
from splatnode.viewer.viewpoint import Viewpoint, move_to_camera, overview

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
    said = [*words.verdict_lines(moment), f"Next view: {words.advice_line(analysis.advice, moment)}"]
    said += [
        *words.bounds_lines(moment),
        *words.depth_lines(moment),
        *words.place_lines(moment),
        *words.count_lines(moment),
        *words.rejection_lines(moment),
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
        line = words.verdict_lines(moment)[0]
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
            line = words.waiting_line(source.age_s if source.age_s == math.inf else 0.0)
            if not came and line != told and time.monotonic() - began_s >= _PATIENCE_S:
                told = line
                say(line)
            time.sleep(_WAIT_S)
