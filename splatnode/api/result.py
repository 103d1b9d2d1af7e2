"""The result of photographs: poses, scene, files, and a viewer of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, Protocol, get_args

import numpy as np
import numpy.typing as npt

from splatnode.api.arguments import enter_api
from splatnode.capture.frame import DroppedFrame, Intrinsics, Stamp
from splatnode.capture.process import python
from splatnode.capture.process.system import remedy
from splatnode.recon import core
from splatnode.recon.result.export import copy_result
from splatnode.recon.result.export.limits import sanitize_gaussians
from splatnode.recon.result.export.staged import hold_result_folder
from splatnode.recon.result.placement import compute_mean_colours, make_flat_sh
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import (
    CameraEstimate,
    GaussianArrays,
    Snapshot,
    find_camera_problem,
    find_confirmed,
)
from splatnode.recon.result.stored_snapshot import LANDMARKS, read_depths, read_landmarks, read_result
from splatnode.recon.result.submap_index import is_map_set
from splatnode.recon.result.verdict import Bounds, ReferenceFrame, Verdict, compute_covariance
from splatnode.recon.result.view_exposure import (
    InterpolatedGains,
    collect_view_gains,
    interpolate_gains,
    relative_illumination,
)
from splatnode.viewer.probe import open3d_installed, probe_window

if TYPE_CHECKING:
    from splatnode.api.photographs import Lens, Picture
    from splatnode.recon.locating import Located, NotLocated
    from splatnode.recon.occupancy import OccupancyMap
    from splatnode.recon.result.snapshot import DepthCheck

# A result in a viewer, which is a process of its own: in a window, in rerun's, or in a browser.
#
# Open3D wants a process's main thread, and ends the process where it finds no Vulkan driver: a program keeps its own.

Viewer = Literal["open3d", "rerun", "browser", "viser"]

_RERUN = ("rerun", "--bind", "127.0.0.1", "--port", "auto")  # by itself it listens everywhere
_OPTIONS = {"open3d": (), "browser": ("--web",), "viser": ("--viser",)}  # of `splatnode view`
_IN_BROWSER = ("browser", "viser")
_ELSEWHERE = "In a browser: result.show('browser')"
_END_S = 10.0  # for a viewer to end, before it is killed


def show(
    result: Result,
    viewer: Viewer = "open3d",
    *,
    listen: str | None = None,
    port: int | None = None,
    opened: Callable[[str], object] = print,
    command: tuple[str, ...] | None = None,
) -> None:
    """As `Result.show`. `command` shows what it gets as its last argument; None: what the viewer is."""
    if viewer not in get_args(Viewer):
        raise ValueError(f"viewer must be one of {', '.join(get_args(Viewer))}; got {viewer!r}")
    if viewer not in _IN_BROWSER and (listen is not None or port is not None):
        raise ValueError(f"listen and port are of {' and '.join(_IN_BROWSER)}; {viewer} opens a window on this machine")
    if not result.verdict.publishable:
        raise ValueError(f"there is no scene to show: {result.verdict.code.value}. Ask verdict.publishable first")
    _check(viewer)
    given = {"--listen": listen, "--port": port}
    options = [part for name, value in given.items() if value is not None for part in (name, str(value))]
    with tempfile.TemporaryDirectory(prefix="splatnode-") as folder:
        shown = result.save(folder)
        if viewer == "rerun":
            _run((*(command or python.command(*_RERUN)), str(_export_rrd(shown))), opened=None)
        else:
            whole = (*(command or python.command("splatnode", "view")), *_OPTIONS[viewer], *options, folder)
            _run(whole, opened if viewer in _IN_BROWSER else None)


def _check(viewer: Viewer) -> None:
    """Raises ModuleNotFoundError without what the viewer needs, RuntimeError where it can open no window."""
    if viewer == "open3d":
        if not open3d_installed():
            raise ModuleNotFoundError(f"the window needs Open3D. {remedy('open3d')}", name="open3d")
        probe = probe_window()
        if not probe.window:
            raise RuntimeError(f"no window can be opened: {probe.detail}. {_ELSEWHERE}")
    elif viewer in ("rerun", "viser"):
        if find_spec(viewer) is None:
            raise ModuleNotFoundError(f"the viewer {viewer} is not installed. {remedy(viewer)}", name=viewer)
        if viewer == "rerun" and sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
            raise RuntimeError(
                f"rerun's window cannot be opened: there is no display ($DISPLAY or $WAYLAND_DISPLAY). {_ELSEWHERE}"
            )


def _export_rrd(folder: Path) -> Path:
    """Exports the result in the folder as `splatnode export --to rrd` does."""
    from splatnode.recon.result.export import export_scene

    return export_scene(folder, "rrd")


def _run(command: tuple[str, ...], opened: Callable[[str], object] | None) -> None:
    """Until the viewer ends, or Ctrl-C ends it. `opened` gets each line that it says.

    Raises RuntimeError where it fails, and what `opened` raises.
    """
    with tempfile.TemporaryFile() as errors:
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, errors="replace")
        assert child.stdout is not None
        try:
            for line in child.stdout:
                if opened is not None:
                    opened(line.strip())
            code = child.wait()
        except KeyboardInterrupt:
            return
        finally:
            _end(child)
            child.stdout.close()
        if code:
            errors.seek(0)
            said = errors.read().decode(errors="replace").strip()[-1000:]
            raise RuntimeError(f"the viewer ended with exit code {code}: {said}")


def _end(child: subprocess.Popen[str]) -> None:
    """As Ctrl-C does, which `python -m rerun` hands on to the window; killed where that does not do."""
    if child.poll() is not None:
        return
    child.send_signal(signal.SIGINT)
    try:
        child.wait(_END_S)
    except subprocess.TimeoutExpired:
        pass
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()


# What came of photographs.

# A camera as a program sees it.

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera of the result: its pose, its lens, and how well they are known.

    Axes are OpenCV's: x right, y down, z forward. The world is the frame that `Result.frame` names; its unit is the
    metre where `Result.metric` is set, and none otherwise.
    """

    name: str  # of the photograph: its file's, or 0000.png, 0001.png, ... where it came as an array
    T_world_camera: Array  # (4, 4) p_world = T_world_camera @ p_camera
    K: Array  # (3, 3) of the photograph at `width` x `height`, without distortion; the top-left pixel is at (0.5, 0.5)
    width: int  # of the photograph as the scene was fitted to it, pixels
    height: int  # likewise, pixels
    # As it was given; or estimated with a distortion that was taken out of the photograph. None: estimated, without any
    lens: Intrinsics | None = None
    bounds: Bounds | None = None  # the claim: its errors are smaller with 95 %; None: nothing is claimed
    captured_at: Stamp | None = None  # nanoseconds, and of which clock; None: nobody knows
    # Share of the photograph's pixels, 0 to 1, whose depth is multi-view consistent: another view has the same point.
    # None: not known, as of a coarse preview
    consistent_depth: float | None = None

    @property
    def T_camera_world(self) -> Array:
        """(4, 4) p_camera = T_camera_world @ p_world."""
        R, t = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
        inverse = np.eye(4)
        inverse[:3, :3], inverse[:3, 3] = R.T, -R.T @ t
        return inverse

    @property
    def centre(self) -> Array:
        """(3,) where it stood, in the world."""
        return self.T_world_camera[:3, 3].copy()

    @property
    def covariance(self) -> Array | None:
        """(3, 3) of its centre, in the world's axes and squared unit, whose 95 % ellipsoid is that of the claim."""
        return None if self.bounds is None else compute_covariance(self.bounds.axes)


def camera_of(estimate: CameraEstimate, lens: Intrinsics | None = None) -> Camera:
    """A camera of a result or a node, with the lens that was given for its photograph."""
    return Camera(
        name=estimate.name,
        T_world_camera=estimate.T_world_camera.copy(),
        K=estimate.K.copy(),
        width=estimate.width,
        height=estimate.height,
        lens=lens or estimate.lens,
        bounds=estimate.bounds,
        captured_at=estimate.captured_at,
        consistent_depth=estimate.consistent_depth,
    )


# What a camera that never was would see of a scene.

MOSTLY = 0.5  # of the light that reaches a pixel


@dataclass(frozen=True, eq=False)
class View:
    """A picture of the scene. H is its height, W its width."""

    rgb: npt.NDArray[np.uint8]  # (H, W, 3) RGB; black where there is nothing
    depth: npt.NDArray[np.float32]  # (H, W) along the camera's z axis, in the world's unit; 0 where there is nothing
    seen: npt.NDArray[np.bool_]  # (H, W) whether most of a pixel's light is of surfaces that two photographs confirm
    gains: npt.NDArray[np.float64]  # (3,) red, green, blue of `rgb` over the scene's own exposure
    gain_sigmas: npt.NDArray[np.float64]  # (3,) standard deviations of their logarithms; 0 in the scene's exposure


def view(
    gaussians: GaussianArrays,
    T_world_camera: npt.ArrayLike,
    K: npt.ArrayLike,
    size: tuple[int, int],
    threads: int | None,
    exposure: InterpolatedGains | None = None,
    falloff: float = 0.0,
) -> View:
    """The Gaussians from a camera of `size` (width, height), in the scene's exposure where `exposure` is None.

    `falloff` is the lens's vignetting, which a view in another exposure gets. Raises ValueError where it is no camera.
    """
    (width, height), pose, lens = _size(size), _matrix("T_world_camera", T_world_camera), _matrix("K", K)
    problem = find_camera_problem(pose, lens, width, height)
    if problem:
        raise ValueError(f"{problem}. Give a camera's own: camera.T_world_camera, camera.K, (camera.width, ...)")
    with core.apply_thread_limit(threads):
        shown = render_arrays(gaussians, pose, lens, width, height, channels=("rgb", "depth"))
        confirmed = find_confirmed(gaussians.source_frame).astype(np.float32)
        white = replace(gaussians, sh=make_flat_sh(np.repeat(confirmed[:, None], 3, 1)))  # and all else black
        light = render_arrays(white, pose, lens, width, height).rgb[..., 0]
    exposed, gains, sigmas = shown.rgb, np.ones(3), np.zeros(3)
    if exposure is not None:
        gains, sigmas = exposure.gains, exposure.sigmas
        exposed = exposed * relative_illumination(falloff, width, height)[..., None] * gains
    rgb = np.rint(255 * np.clip(exposed, 0.0, 1.0)).astype(np.uint8)
    return View(rgb, shown.depth, light > MOSTLY, gains, sigmas)


def _interpolate_exposure(
    snapshot: Snapshot, T_world_camera: Array, captured_at: Stamp | None
) -> tuple[InterpolatedGains | None, float]:
    """Interpolates the gains of a view, and finds its lens's falloff; None where nothing was taken out."""
    if not snapshot.cameras or not (snapshot.gains or snapshot.falloffs):
        return None, 0.0
    known = collect_view_gains(snapshot.cameras, snapshot.gains, snapshot.gain_sigmas)
    falloffs = [snapshot.falloffs.get(camera.name, 0.0) for camera in snapshot.cameras]
    time_s = None
    if captured_at is not None and known.times_s is not None:
        clock = next(camera.captured_at.clock for camera in snapshot.cameras if camera.captured_at)
        if captured_at.clock != clock:
            raise ValueError(f"captured_at must be on the cameras' clock {clock.name}, got {captured_at.clock.name}")
        time_s = captured_at.ns / 1e9
    return interpolate_gains(known, T_world_camera, time_s), float(np.median(falloffs))


def _matrix(name: str, given: npt.ArrayLike) -> npt.NDArray[np.float64]:
    try:
        return np.asarray(given, np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be a matrix of numbers, got {type(given).__name__}") from error


def _size(size: tuple[int, int]) -> tuple[int, int]:
    try:
        width, height = size
        if int(width) == width and int(height) == height:
            return int(width), int(height)
    except (TypeError, ValueError):
        pass
    raise TypeError(f"size must be (width, height) in whole pixels, got {size!r}")


class Files(Protocol):
    """The files of a result, which know how it is written."""

    def write(self, out: Path) -> object:
        """Writes the result folder. Raises ResultWriteError."""


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """The verdict on photographs and, where it is publishable, their cameras and the scene.

    Made by `reconstruct`, `load`, a `Session` or a `Node`. It can be pickled and used by several threads. Arrays that
    it gives are copies: a program may change them.
    """

    _snapshot: Snapshot
    _files: Files
    _lenses: Mapping[str, Intrinsics] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict:
        """Whether there is a scene (`publishable`), and why: `code`, `message`, `advice`, and `frames` it is about."""
        return self._snapshot.verdict

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """One for each photograph that was placed, in the order in which they were given; none after a refusal."""
        return tuple(camera_of(each, self._lenses.get(each.name)) for each in self._snapshot.cameras)

    @property
    def dropped(self) -> tuple[DroppedFrame, ...]:
        """The photographs that were left out, each with `name` and `reason`."""
        return self._snapshot.dropped

    @property
    def gaussians(self) -> dict[str, npt.NDArray]:
        """N Gaussians by what is known of them; N is 0 after a refusal.

        `means` (N, 3) centres in the world; `quats` (N, 4) rotations, wxyz, of unit length; `scales` (N, 3) standard
        deviations along their axes; `opacities` (N,) in (0, 1); `sh` (N, B, 3) spherical harmonics, B being 1, 4, 9 or
        16; `colours` (N, 3) RGB in [0, 1], without what depends on the direction; `seen` (N,) whether two photographs
        confirm its depth. All but `seen` are float32.
        """
        have = self._snapshot.gaussians
        known = {name: getattr(have, name).copy() for name in ("means", "quats", "scales", "opacities", "sh")}
        return known | {"colours": compute_mean_colours(have.sh), "seen": find_confirmed(have.source_frame)}

    @property
    def consistent_depth(self) -> float | None:
        """The share of all pixels, 0 to 1, whose depth is multi-view consistent: another view has the same point.

        It is the mean of `Camera.consistent_depth` over `cameras`. Where it is small, the scene is measured from its
        cameras alone and a guess from elsewhere: `verdict.message` says so below the configured limit. None: not
        known, as of a coarse preview, after a refusal, or where an earlier splatnode wrote the result.
        """
        return self._snapshot.consistent_depth

    @property
    def seconds(self) -> dict[str, float]:
        """How long it took, by stage, and `total`."""
        return dict(self._snapshot.seconds)

    @property
    def metric(self) -> bool:
        """Whether lengths are metres. Otherwise they have no unit: the median depth of the scene is about 1."""
        return self._snapshot.scale.metric

    @property
    def scale_interval(self) -> tuple[float, float] | None:
        """A true length is at least and at most so many times the stated one: 95 %. None where that is not known."""
        return self._snapshot.scale.interval_95

    @property
    def frame(self) -> ReferenceFrame:
        """The frame of reference of all coordinates: `name`, how it is known, and `T_frame_first_camera`."""
        return self._snapshot.scale.frame

    @property
    def scale_source(self) -> str | None:
        """The scale source, or why there is none although one was asked for. None: nothing was asked for."""
        return self._snapshot.scale.source

    @property
    def depth_checks(self) -> tuple[DepthCheck, ...]:
        """The judgement of the images on each camera's depth images; empty where none came."""
        return self._snapshot.depth_checks

    @property
    def final(self) -> bool:
        """Whether all photographs were judged with all evidence, and the scene is refined."""
        return self._snapshot.final

    @enter_api()
    def render(
        self,
        T_world_camera: npt.ArrayLike,
        K: npt.ArrayLike,
        size: tuple[int, int],
        *,
        exposure: Literal["interpolated", "scene"] = "interpolated",
        captured_at: Stamp | None = None,
        threads: int | None = None,
    ) -> View:
        """Renders the camera at `T_world_camera` (4, 4) with pinhole `K` (3, 3); `size` is (width, height) in pixels.

        Axes and pixels are those of `Camera`. Raises ValueError where there is no scene, or these are no camera, and
        TypeError for other types.

        - `exposure`: "interpolated": as the camera would have exposed it, by the gains of the photographs around it and
          the vignetting of their lens; `View.gains` and `View.gain_sigmas` tell it. "scene": one for all views, as in
          the viewer and in exports. Photographs of one exposure make no difference.
        - `captured_at`: when, if the photographs tell when they were taken; gains are then interpolated in time, too.
        - `threads`: the most that the work takes; None: as many as there are processors.
        """
        if not self.verdict.publishable:
            raise ValueError(f"there is no scene to render: {self.verdict.code.value}. Ask verdict.publishable first")
        if exposure not in ("interpolated", "scene"):
            raise ValueError(f"exposure must be 'interpolated' or 'scene', got {exposure!r}")
        pose = _matrix("T_world_camera", T_world_camera)
        interpolated, falloff = None, 0.0
        if exposure == "interpolated" and pose.shape == (4, 4):
            interpolated, falloff = _interpolate_exposure(self._snapshot, pose, captured_at)
        return view(self._snapshot.gaussians, pose, K, size, threads, interpolated, falloff)

    @enter_api()
    def localise(
        self,
        image: str | PathLike[str] | Picture,
        *,
        intrinsics: Lens | None = None,
        near: Located | NotLocated | npt.ArrayLike | None = None,
    ) -> Located | NotLocated:
        """Localizes a query image, or says why it cannot: a refusal is a value.

        - `image`: a file or an image of any camera; `intrinsics`: its lens if known, `Intrinsics` or K (3, 3).
        - `near`: the outcome of the same camera's previous image, or T_world_camera (4, 4) near this one's: the search
          is faster there, and continues everywhere if it fails.

        `Located` has `T_world_camera`, `K`, `covariance` and the 95 % bounds `claim`; `NotLocated` has `code`,
        `message` and `advice`. Raises ValueError without a scene, TypeError for other types, and FileNotFoundError.
        """
        from splatnode.api.photographs import localize_query  # brings what matches photographs

        landmarks = self._snapshot.landmarks
        if landmarks is None:
            why = "it has no landmarks: it is not final, or was written before there were any. Reconstruct it again"
            if not self.verdict.publishable:
                why = f"there is none: {self.verdict.code.value}. Ask verdict.publishable first"
            raise ValueError(f"no scene to look for a photograph in: {why}")
        return localize_query(landmarks, image, intrinsics, near)

    @enter_api()
    def map(self, *, voxel: float | None = None, up: npt.ArrayLike | None = None) -> OccupancyMap:
        """Which space is free, occupied, or not seen, by depths that two photographs confirm and by nothing else.

        `voxel` is the side of a voxel in the result's unit; None: a 64th of the median depth. `up` (3,) is the
        direction of up in the world; None: the floor tells it, or the cameras, as `upright.source` says. Raises
        ValueError where no map can be made of the result, with the reason, or these are no size and no direction.
        """
        from splatnode.recon.occupancy import occupancy_map  # brings what carves

        return occupancy_map(self._snapshot, voxel, None if up is None else np.asarray(up, np.float64))

    @enter_api()
    def save(self, folder: str | PathLike[str]) -> Path:
        """Writes the files that `splatnode replay --out FOLDER` writes, and returns the folder.

        A result that lies there already is replaced; of a refusal there is a report alone. Photographs that came as
        arrays, and the keyframes of a video, are written into `images`. Raises OSError, with what was there before
        intact, where that cannot be done.
        """
        out = Path(folder)
        with hold_result_folder(out):
            self._files.write(out)
        return out

    @enter_api()
    def show(
        self,
        viewer: Viewer = "open3d",
        *,
        listen: str | None = None,
        port: int | None = None,
        opened: Callable[[str], object] = print,
    ) -> None:
        """Shows the result in a viewer of its own process; returns when that is closed, or at Ctrl-C.

        - `viewer`: "open3d", "rerun", "browser" (as `splatnode view --web`) or "viser".
        - `listen`: of "browser" (with a key) and "viser" (without), a numeric address such as "0.0.0.0" at which other
          machines are let in. None: this machine only.
        - `port`: of these. None: 8347, of viser 8080; 0: any free one.
        - `opened`: of these, called with a line that has the address, once it can be opened.

        Raises ModuleNotFoundError where the viewer is not installed (`pip install 'splatnode[viewer]'` for Open3D,
        `[rerun]`, `[viser]`), RuntimeError where it fails, ValueError for wrong arguments or without a scene.
        """

        show(self, viewer, listen=listen, port=port, opened=opened)

    def __repr__(self) -> str:
        counts = f"{len(self._snapshot.cameras)} cameras, {len(self._snapshot.gaussians)} Gaussians"
        return f"<splatnode.Result {self.verdict.code.value}: {counts}, {len(self.dropped)} left out>"


def result_of(snapshot: Snapshot, files: Files, lenses: Mapping[str, Intrinsics] = MappingProxyType({})) -> Result:
    """A snapshot as a program sees it: with the Gaussians that its files would have."""
    return Result(replace(snapshot, gaussians=sanitize_gaussians(snapshot.gaussians)), files, dict(lenses))


# A result that was written, read again.


@dataclass(frozen=True)
class StoredFiles:
    """The files of a result, where they were read."""

    folder: Path

    def write(self, out: Path) -> None:
        copy_result(self.folder, out)


@enter_api()
def load(folder: str | PathLike[str]) -> Result:
    """The result in a folder that `Result.save`, `splatnode replay` or a node wrote; a refusal, too.

    Which lenses were given is not in the files. Saving it again copies the files. Raises FileNotFoundError where there
    is no result, ValueError where the files are something else or damaged.
    """
    place = Path(folder)
    if not place.is_dir():
        raise FileNotFoundError(f"{place} is no folder; give one that Result.save or splatnode replay --out wrote")
    if is_map_set(place):
        scenes = ", ".join(sorted(path.parent.name for path in place.glob("*/report.json")))
        raise ValueError(f"{place} holds several results; give one of its folders: {scenes}")
    snapshot = read_result(place)[0]
    if (place / LANDMARKS).exists():
        snapshot = replace(snapshot, landmarks=read_landmarks(place))
    snapshot = replace(snapshot, depths=read_depths(place))
    return result_of(snapshot, StoredFiles(place.resolve()))
