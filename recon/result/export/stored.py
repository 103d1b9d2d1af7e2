"""A result on disk, read as far as somebody asks for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Annotated, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import LARGEST_NS, Clock, Intrinsics, Stamp
from splatnode.capture.process import plugins
from splatnode.capture.process.config import record_in
from splatnode.capture.process.text import LONGEST_NAME, LONGEST_TEXT, guard_untrusted, is_printable, sanitize_text
from splatnode.recon.result.export import formats
from splatnode.recon.result.export.limits import (
    EVERYTHING,
    MAX_CAMERAS,
    MAX_JSON_BYTES,
    SceneFileError,
    Selection,
    read_json_file,
    read_scene_file,
    sanitize_gaussians,
)
from splatnode.recon.result.export.staged import json_bytes
from splatnode.recon.result.snapshot import (
    MAX_COORDINATE,
    CameraEstimate,
    GaussianArrays,
    GivenCameraPose,
    find_camera_problem,
)
from splatnode.recon.result.verdict import (
    RELATIVE,
    Bounds,
    FrameName,
    ReferenceFrame,
    Scale,
    encode_matrix,
    find_frame_problem,
)

# cameras.json: our own file of cameras, which every result has and from which other formats are made.
#
# The cameras are for the images at modelled size, with the centre of the top-left pixel at (0.5, 0.5). The file
# states the world's unit and its frame of reference.

Number = Annotated[float, msgspec.Meta(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Row3: TypeAlias = tuple[Number, Number, Number]
Row4: TypeAlias = tuple[Number, Number, Number, Number]
Low = Annotated[float, msgspec.Meta(gt=0, le=1)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
High = Annotated[float, msgspec.Meta(ge=1, le=MAX_COORDINATE)]
Text = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]

STAMP_MEANING = "nanoseconds when the photograph was captured, or null; clock says of what time: " + "; ".join(
    f"{clock.value}, {clock.meaning}" for clock in Clock
)
BOUNDS_MEANING = (
    "hold for 95 % of all cameras: rotation_deg after the best common rotation, centre (in the file's unit) and "
    "centre_percent (of the distance to the scene) after the best similarity, focal_percent of the focal length; axes "
    "are the semi-axes of the ellipsoid around the centre, in the file's unit and world"
)

LENS_MEANING = (
    "estimated, in pixels of the photograph in full size: its distortion (OpenCV's k1 k2 p1 p2) was taken out of the "
    "picture that K, width and height are of; null: nothing estimated was"
)

GIVEN_LENS_MEANING = (
    "as it was given, in pixels of the photograph in full size: its distortion, and the difference of fx and fy, were "
    "taken out of the picture that K, width and height are of; null: none was given, or it was a pinhole with fx = fy"
)

CONSISTENT_DEPTH_MEANING = (
    "share of the photograph's pixels, 0 to 1, whose depth is multi-view consistent: a point of another view has it, "
    "too; null: not known"
)


FRAME_SET_MEANING = (
    "camera_id says which of several cameras took the photograph, and photographs of one frame_set were taken "
    "together; null: there is one camera, or nothing tells"
)

FRAME_MEANING = (
    "of all coordinates: first_camera, base (the robot's, at the first image), odometry (that of the given poses) or "
    "upright (at the first camera, z up); p_frame = T_frame_first_camera @ p_first_camera, in the file's unit"
)

GIVEN_MEANING = (
    "the pose that was given for the camera, with its standard deviations, and how far it is from the estimated one; "
    "null: none was given, or nothing tells where its world lies"
)


def make_camera_dict(camera: CameraEstimate) -> dict[str, object]:
    """A camera as cameras.json and report.json hold it."""
    return {
        "name": camera.name,
        "frame_id": camera.frame_id,
        **make_stamp_dict(camera.captured_at),
        "T_world_camera": camera.T_world_camera.tolist(),
        "K": camera.K.tolist(),
        "width": camera.width,
        "height": camera.height,
        "lens": None if camera.lens is None else asdict(camera.lens),
        "given_lens": None if camera.given_lens is None else asdict(camera.given_lens),
        "bounds": None if camera.bounds is None else asdict(camera.bounds),
        "consistent_depth": None if camera.consistent_depth is None else round(camera.consistent_depth, 4),
        "camera_id": camera.camera_id or None,
        "frame_set": camera.frame_set,
        "given": make_given_dict(camera),
    }


def make_given_dict(camera: CameraEstimate) -> dict[str, object] | None:
    """The pose that was given for a camera, beside the estimated one; None where none was."""
    residual = camera.pose_residual
    if camera.given is None or residual is None:
        return None
    return {
        "T_world_camera": camera.given.T_world_camera.tolist(),
        "sigma_m": camera.given.sigma_m,
        "sigma_deg": camera.given.sigma_deg,
        "residual_m": residual[0],
        "residual_deg": residual[1],
    }


def make_stamp_dict(stamp: Stamp | None) -> dict[str, object]:
    """A time of capture as the files hold it."""
    return {"stamp_ns": stamp and stamp.ns, "clock": stamp and stamp.clock.value}


def encode_cameras(cameras: Sequence[CameraEstimate], scale: Scale = RELATIVE) -> bytes:
    """cameras.json."""
    return json_bytes(
        {
            **scale.record(),
            "frame_meaning": FRAME_MEANING,
            "axes": "OpenCV: x right, y down, z forward",
            "T_world_camera": "p_world = T_world_camera @ p_camera",
            "stamp_ns": STAMP_MEANING,
            "lens": LENS_MEANING,
            "given_lens": GIVEN_LENS_MEANING,
            "bounds": BOUNDS_MEANING,
            "consistent_depth": CONSISTENT_DEPTH_MEANING,
            "frame_set": FRAME_SET_MEANING,
            "given": GIVEN_MEANING,
            "pixel_origin": "the centre of the top-left pixel is (0.5, 0.5)",
            "cameras": [make_camera_dict(camera) for camera in cameras],
        }
    )


class _Bounds(msgspec.Struct, frozen=True):
    rotation_deg: Number
    centre: Number
    centre_percent: Number
    focal_percent: Number
    axes: tuple[Row3, Row3, Row3]


class _Given(msgspec.Struct, frozen=True):
    T_world_camera: tuple[Row4, Row4, Row4, Row4]
    sigma_m: Annotated[float, msgspec.Meta(ge=0, le=MAX_COORDINATE)]
    sigma_deg: Annotated[float, msgspec.Meta(ge=0, le=180)]


class _Camera(msgspec.Struct, frozen=True):
    name: Text
    frame_id: Annotated[int, msgspec.Meta(ge=-1, lt=1 << 31)]
    T_world_camera: tuple[Row4, Row4, Row4, Row4]
    K: tuple[Row3, Row3, Row3]
    width: int
    height: int
    bounds: _Bounds | None = None
    stamp_ns: Annotated[int, msgspec.Meta(ge=0, le=LARGEST_NS)] | None = None
    clock: Clock | None = None
    lens: Intrinsics | None = None
    consistent_depth: Share | None = None
    camera_id: Annotated[str, msgspec.Meta(max_length=LONGEST_NAME)] | None = None
    frame_set: Annotated[int, msgspec.Meta(ge=0, lt=1 << 31)] | None = None
    given: _Given | None = None
    given_lens: Intrinsics | None = None


class _File(msgspec.Struct, frozen=True):
    cameras: Annotated[tuple[_Camera, ...], msgspec.Meta(max_length=MAX_CAMERAS)]
    scale: Text | None = None
    scale_source: str | None = None
    scale_interval_95: tuple[Low, High] | None = None
    frame: FrameName = FrameName.FIRST_CAMERA
    frame_source: str | None = None
    frame_sigma_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] | None = None
    T_frame_first_camera: tuple[Row4, Row4, Row4, Row4] | None = None


def decode_cameras(data: bytes, name: str = "cameras.json") -> tuple[CameraEstimate, ...]:
    """Reads cameras.json: at most MAX_CAMERAS cameras of different names, each a rigid motion and a pinhole.

    Raises SceneFileError, which names the file as `name`, where it is something else.
    """
    with guard_untrusted(SceneFileError, name):
        cameras = tuple(_make_camera(record, name) for record in _parse_file(data, name).cameras)
        if len({camera.name for camera in cameras}) < len(cameras):
            raise SceneFileError(f"{name} has two cameras of one name")
        return cameras


def decode_scale(data: bytes, name: str = "cameras.json") -> Scale:
    """The unit and the frame that a cameras.json of ours states. Raises SceneFileError."""
    with guard_untrusted(SceneFileError, name):
        parsed = _parse_file(data, name)
        source = parsed.scale_source and sanitize_text(parsed.scale_source)
        return Scale(parsed.scale == "metric", source, parsed.scale_interval_95, _make_frame(parsed, name))


def _make_frame(parsed: _File, name: str) -> ReferenceFrame:
    """The frame of reference; that of the first camera where the file is older than frames. Raises SceneFileError."""
    T = np.eye(4) if parsed.T_frame_first_camera is None else np.array(parsed.T_frame_first_camera)
    if problem := find_frame_problem(T):
        raise SceneFileError(f"{name}: {problem}")
    source = parsed.frame_source and sanitize_text(parsed.frame_source)
    return ReferenceFrame(parsed.frame, source, parsed.frame_sigma_deg, encode_matrix(T))


def _parse_file(data: bytes, name: str) -> _File:
    if len(data) > MAX_JSON_BYTES:
        raise SceneFileError(f"{name} has {len(data)} bytes; at most {MAX_JSON_BYTES} are read")
    try:
        parsed = record_in(data, _File)
    except msgspec.MsgspecError as error:
        raise SceneFileError(f"{name} is not a cameras.json of splatnode, or is damaged: {error}") from error
    for field, text in (("scale_source", parsed.scale_source), ("frame_source", parsed.frame_source)):
        if not (text or "").isprintable():
            raise SceneFileError(f"{name}: {field} must be printable text")
    return parsed


def _numbers_of(bounds: _Bounds) -> tuple[float, ...]:
    return bounds.rotation_deg, bounds.centre, bounds.centre_percent, bounds.focal_percent


def _make_camera(record: _Camera, name: str) -> CameraEstimate:
    T_world_camera, K = np.array(record.T_world_camera), np.array(record.K)
    problem = find_camera_problem(T_world_camera, K, record.width, record.height)
    if not is_printable(record.name) or any(part in ("", ".", "..") for part in record.name.split("/")):
        problem = "a name must be that of a file, or of one in a folder of its camera, in printable letters"
    if (record.stamp_ns is None) != (record.clock is None):
        problem = "stamp_ns and clock must be there both, or none"
    if record.bounds is not None and min(_numbers_of(record.bounds)) < 0:
        problem = f"bounds must not be below 0, got {min(_numbers_of(record.bounds)):g}"
    if record.given is not None:
        problem = problem or find_camera_problem(np.array(record.given.T_world_camera), K, record.width, record.height)
    if problem:
        raise SceneFileError(f"{name}, camera {sanitize_text(record.name, 100)!r}: {problem}")
    bounds = record.bounds and Bounds(**msgspec.structs.asdict(record.bounds))
    captured_at = None if record.stamp_ns is None or record.clock is None else Stamp(record.stamp_ns, record.clock)
    size = record.width, record.height
    known = bounds, captured_at, record.lens, record.consistent_depth
    known = *known, sanitize_text(record.camera_id or ""), record.frame_set, _make_given(record.given)
    known = *known, record.given_lens
    return CameraEstimate(record.name, record.frame_id, T_world_camera, K, *size, *known)


def _make_given(record: _Given | None) -> GivenCameraPose | None:
    return record and GivenCameraPose(np.array(record.T_world_camera), record.sigma_m, record.sigma_deg)


# A result on disk, read as far as somebody asks for it.

# sources.bin: the source frames of a result's Gaussians (`recon.result.snapshot`), which scene files have no place for.
#
# Little-endian int32, one a Gaussian, in the order of the scene.ply beside it.

SOURCES = "sources.bin"


def encode_sources(source_frame: npt.NDArray[np.int32]) -> bytes:
    return source_frame.astype("<i4").tobytes()


def decode_sources(data: bytes, num_gaussians: int) -> npt.NDArray[np.int32]:
    """The source frames (N,) of so many Gaussians. Raises SceneFileError where there are not so many."""
    if len(data) != 4 * num_gaussians:
        raise SceneFileError(
            f"{SOURCES} tells where {len(data) / 4:g} Gaussians come from, the scene file beside it has "
            f"{num_gaussians}: one of the two is not what was written. Make the scene anew"
        )
    return np.frombuffer(data, "<i4").astype(np.int32)


@dataclass(frozen=True)
class StoredResult:
    """A scene file, and the cameras.json beside it. Files are read when they are asked for.

    What is asked for raises FileNotFoundError where its file is not there, SceneFileError where the file is something
    else, OSError where it cannot be read.
    """

    scene: Path
    selection: Selection = EVERYTHING  # of its Gaussians

    @classmethod
    def create_from_path(cls, path: Path, selection: Selection = EVERYTHING) -> StoredResult:
        """The result in a folder, or that of a scene file."""
        return cls(path / "scene.ply" if path.is_dir() else path, selection)

    def gaussians(self) -> GaussianArrays:
        """Those that are selected, with finite values and bounded extents."""
        sources = self._find_sources() if self.selection.needs_sources else None
        return self.selection.apply(read_gaussians(_check_exists(self.scene), sources), self.scene.name)

    def cameras(self) -> tuple[CameraEstimate, ...]:
        return read_cameras(_check_exists(self._cameras))

    def scale(self) -> Scale:
        """The unit of the lengths, as cameras.json states it; relative where there is no such file."""
        return decode_scale(read_json_file(self._cameras), self._cameras.name) if self._cameras.is_file() else RELATIVE

    def _find_sources(self) -> Path:
        """Finds the file of the Gaussians' source frames. Raises SceneFileError where there is none."""
        path = self.scene.with_name(SOURCES)
        if self.scene.suffix.lower() != ".ply" or not path.is_file():
            raise SceneFileError(
                f"{self.scene} does not tell which Gaussians two photographs confirm, or which are the far background: "
                f"that is in the {SOURCES} beside "
                "a result's scene.ply, which merged maps, and results of earlier versions, do not have. "
                "Make the scene anew: splatnode replay FOLDER --out DIR"
            )
        return path

    @property
    def _cameras(self) -> Path:
        return self.scene.with_name("cameras.json")


def read_gaussians(path: Path, sources: Path | None = None) -> GaussianArrays:
    """The Gaussians of a scene file (.ply, .spz, .splat), with finite values and bounded extents.

    Their source frames are unknown but where `sources` has them.
    Raises SceneFileError where the file is truncated or is something else, OSError where it cannot be read.
    """
    decoders = _load_decoders(path.suffix.lower())
    decode = decoders.get(path.suffix.lower())
    if decode is None:
        raise SceneFileError(f"{path.name} must end with {', '.join(decoders)}")
    # NumPy warns of a NaN that signals, and of what is too large, before it is looked for and left out.
    with guard_untrusted(SceneFileError, path.name), np.errstate(all="ignore"):
        gaussians = decode(read_scene_file(path), path.name)
        if sources is not None:
            source_frame = decode_sources(read_scene_file(sources), len(gaussians))
            gaussians = replace(gaussians, source_frame=source_frame)
        safe = sanitize_gaussians(gaussians)
        if len(gaussians) and not len(safe):
            raise SceneFileError(f"{path.name} holds {len(gaussians)} Gaussians, none of them with finite values")
        return safe


def read_cameras(path: Path) -> tuple[CameraEstimate, ...]:
    """The cameras of a cameras.json. Raises SceneFileError, OSError."""
    return decode_cameras(read_json_file(path), path.name)


def _load_decoders(suffix: str) -> dict[str, Callable[[bytes, str], GaussianArrays]]:
    """Loads the decoders by suffix: those here, and that of `suffix`. A format can be read if it has `decode`."""
    modules = {name: import_module(f"{formats.__name__}.{name}") for _, name, _ in iter_modules(formats.__path__)}
    further = plugins.entry_points(plugins.EXPORT_FORMATS)
    if (name := suffix.removeprefix(".")) in further and name not in modules:
        modules[name] = further[name].load()
    return {f".{name}": module.decode for name, module in sorted(modules.items()) if hasattr(module, "decode")}


def _check_exists(path: Path) -> Path:
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is not there. Give the folder of a result (splatnode replay FOLDER --out DIR), or a scene file; "
            "the formats of cameras need the result's cameras.json beside it"
        )
    return path
