"""`splatnode view`: a result, a scene file or a running node, in a window, in a browser or as pictures.

Pictures need no window: a PNG series, an MP4 turntable, and a picture that is kept up to date.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import math
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.image_file import encode_png
from splatnode.capture.messaging.network import Network
from splatnode.capture.process.config import parse_config, read_yaml
from splatnode.capture.process.terminal import (
    ProgressStep,
    Tell,
    ignore_progress,
    report_items,
    say,
    show_progress,
    show_waiting,
)
from splatnode.recon.result.export import LIVE_PICTURE, ResultWriteError, write_beside, write_files
from splatnode.recon.result.rendering import use_threads
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.stored_snapshot import load_images
from splatnode.recon.result.submap_index import is_map_set
from splatnode.viewer import session, web
from splatnode.viewer.analysis import Analysis, analyse
from splatnode.viewer.probe import open3d_installed, probe_window, splash
from splatnode.viewer.session import Session
from splatnode.viewer.shapes import (
    Ground,
    Shapes,
    add_caption,
    blend_image,
    ground,
    ground_lines,
    legend,
    merge_shapes,
    paint,
    shapes,
)
from splatnode.viewer.sources import BUDGET, FixedSource, LiveSource, Maps, MapSource, Source, load_result, map_moment
from splatnode.viewer.state import Moment, ViewerState, Viewpoint, look_at, move_to_camera, overview
from splatnode.viewer.verbs import find_chosen, load_viewers

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
    said = [*session.verdict_lines(moment), f"Next view: {session.advice_line(analysis.advice, moment)}"]
    said += [
        *session.bounds_lines(moment),
        *session.depth_lines(moment),
        *session.place_lines(moment),
        *session.count_lines(moment),
        *session.rejection_lines(moment),
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
        line = session.verdict_lines(moment)[0]
        say(f"{folder / LIVE_PICTURE}: {line} ({time.perf_counter() - started:.1f} s)")
        if until_final and moment.snapshot.final:
            return


def _wait_for_moments(source: Source, say: Callable[[str], None]) -> Iterator[Moment]:
    """Those that come; says what it waits for before the first one, after a second and when the node is heard of."""
    began_s, came, last_line = time.monotonic(), False, ""
    while True:
        moment = source.take()
        if moment is not None:
            came = True
            yield moment
        elif source.age_s is None:
            return
        else:
            line = session.waiting_line(source.age_s if source.age_s == math.inf else 0.0)
            if not came and line != last_line and time.monotonic() - began_s >= _PATIENCE_S:
                last_line = line
                say(line)
            time.sleep(_WAIT_S)


EXIT_GOOD, EXIT_UNAVAILABLE = 0, 69

_NICENESS = 5  # the reconstruction is more important than the picture of it
_NO_OPEN3D = (
    "splatnode: the window needs Open3D, which is not installed. Run: pip install 'splatnode[viewer]'. "
    "A browser needs nothing more: splatnode view ... --web; nor do pictures: --headless, or --export turntable.mp4"
)

_PICTURE = 960, 720  # pixels, where no window is opened


def view(args: argparse.Namespace) -> int:
    """Shows what `args.what` names. Raises what opening it raises."""
    _check_web(args)
    further = find_chosen(args)
    if not (args.web or further or args.headless or args.export is not None):
        return _show_in_window(args)
    with show_waiting("reading the scene"):
        finished, network = _load_finished_source(args), _network(args)
    if args.web:
        where = web.resolve_address(args.listen, web.PORT if args.port is None else args.port, args.key)
        web.show(_source(finished, network), where, _lower_priority, say)
    if further is not None:
        _lower_priority()
        further.show(_source(finished, network), args)
        return EXIT_GOOD
    if args.export is None:
        return _write_pictures(args, finished, network)
    if finished is None or args.export.suffix.lower() != ".mp4":
        raise ValueError("--export needs a finished result and a file that ends with .mp4")
    width, height = args.size or _PICTURE
    with show_progress() as tell:
        say(write_movie(_moment(finished), args.export, width, height, args.num_frames, of=args.what, tell=tell))
    return EXIT_GOOD


def _show_in_window(args: argparse.Namespace) -> int:
    """Shows it in a window, or as pictures where there can be none."""
    installed = open3d_installed()
    with splash() if installed else contextlib.nullcontext(_do_nothing) as ready, ThreadPoolExecutor(1) as beside:
        finished, network = _load_finished_source(args), _network(args)
        if not installed:
            say(_NO_OPEN3D, error=True)
            return EXIT_UNAVAILABLE
        probing = beside.submit(probe_window)
        with contextlib.suppress(ImportError):  # the probe tells of it
            import_module("splatnode.viewer.window")  # brings Open3D, which takes as long as the probe
        probe = probing.result()
        if not probe.window:
            say(f"splatnode: no window: {probe.detail}. Writing pictures instead, as with --headless", error=True)
            ready()
            return _write_pictures(args, finished, network)
        source = _source(finished, network)
        from splatnode.viewer.window import show

        def on_open() -> None:
            ready()
            if finished is None:
                _lower_priority()

        session, size = Session(source, ViewerState()), args.size or probe.size
        show(session, software=probe.software, screenshots=_folder(args, finished), opened=on_open, size=size)
    return EXIT_GOOD


def _write_pictures(args: argparse.Namespace, finished: Moment | Maps | None, network: Network) -> int:
    width, height = args.size or _PICTURE
    folder = _folder(args, finished)
    if finished is not None:
        with show_progress() as tell:
            say(write_series(_moment(finished), folder, width, height, args.num_frames, of=args.what, tell=tell))
        return EXIT_GOOD
    source = _source(finished, network)
    _lower_priority()
    with contextlib.closing(source):
        update_picture(source, folder, width, height, until_final=args.exit_when_final, say=say)
    return EXIT_GOOD


def _folder(args: argparse.Namespace, finished: Moment | Maps | None) -> Path:
    """Returns the folder for pictures and edited scenes."""
    return args.out or (_default_folder(args.what) if finished is not None else Path("view"))


def _check_web(args: argparse.Namespace) -> None:
    """Raises ValueError for options that do not go together."""
    if args.key is not None and not args.web:
        raise ValueError("--key needs --web")
    alone = [name for name in ("port", "listen") if getattr(args, name) is not None]
    viewers = load_viewers()
    further = find_chosen(args)
    servers = [viewer.name for viewer in viewers if viewer.is_server]
    if alone and not args.web and (further is None or not further.is_server):
        raise ValueError(f"--{alone[0]} needs --{' or --'.join(['web', *servers])}")
    for viewer in viewers:
        viewer.check(args)
    if further is not None and (args.web or args.headless or args.export is not None):
        raise ValueError(f"--{further.name} {further.shows}; leave out --web, --headless and --export")
    if args.web and (args.headless or args.export is not None):
        raise ValueError("--web shows it in a browser; --headless and --export write pictures: one of them at a time")


def _load_finished_source(args: argparse.Namespace) -> Moment | Maps | None:
    """The result, or the folder of many, that is named; None where it is a running node."""
    if args.images is not None and not args.images.is_dir():
        raise FileNotFoundError(f"--images must be the folder of a result's photographs; {args.images} is none")
    if args.what is None or _is_configuration(args.what):
        return None
    if is_map_set(args.what):
        folder = args.images or args.what / "images"
        return Maps(args.what, lambda cameras: load_images(cameras, [folder]), args.max_gaussians or BUDGET)
    return load_result(args.what, args.images)


def _moment(finished: Moment | Maps) -> Moment:
    return finished if isinstance(finished, Moment) else map_moment(finished)


def _network(args: argparse.Namespace) -> Network:
    """Returns the network of the running node: that of its configuration, if one is named."""
    raw = read_yaml(args.what) if args.what is not None and _is_configuration(args.what) else {}
    return parse_config(raw.get("network", {}), Network, "network")


def _is_configuration(what: Path) -> bool:
    return what.suffix.lower() in (".yaml", ".yml")


def _source(finished: Moment | Maps | None, network: Network) -> Source:
    if finished is None:
        return LiveSource(network)
    return FixedSource(finished) if isinstance(finished, Moment) else MapSource(finished)


def _do_nothing() -> None:
    """Closes the splash that there is none of."""


def _lower_priority() -> None:
    """Beside a running node the viewer takes one thread, and steps back where the node wants the processors.

    Not before it is open: starting costs the node little, and the person should not wait for it.
    """
    use_threads(1)
    cv2.setNumThreads(1)
    os.nice(_NICENESS)


def _default_folder(what: Path) -> Path:
    return (what if what.is_dir() else what.parent) / "view"
