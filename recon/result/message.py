"""A snapshot as a message, for viewers: without torch on either side.

Arrays: means, quats, scales, opacities, sh, source_frame of the Gaussians, then of each camera, in their order, a small
photograph (JPEG).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import UNSET, UnsetType

from splatnode.capture.frame import (
    LARGEST_SIDE,
    DroppedFrame,
    Intrinsics,
    Stamp,
    make_optional_field,
    read_optional_field,
)
from splatnode.capture.messaging.messages import (
    Amount,
    Count,
    Finite,
    Header,
    Message,
    Name,
    Sequential,
    Text,
    WireError,
    decode_jpeg,
    make_jpeg_array,
)
from splatnode.capture.process.text import LONGEST_NAME, guard_untrusted, sanitize_text
from splatnode.recon.result.snapshot import (
    CameraEstimate,
    DepthCheckRecord,
    GaussianArrays,
    GivenCameraPose,
    Snapshot,
    find_camera_problem,
    make_depth_check_record,
)
from splatnode.recon.result.verdict import (
    FIRST_CAMERA,
    RELATIVE,
    Bounds,
    Code,
    FrameName,
    ReferenceFrame,
    Scale,
    Verdict,
    find_frame_problem,
)

THUMBNAIL_SIDE = 320  # pixels
THUMBNAIL_QUALITY = 85  # of 100, as JPEG
MAX_NAMES = 1000  # of frames that a verdict is about
MAX_DROPPED = 200  # that are named with their reasons
MAX_DEPTH_CAMERAS = 100  # whose depth images are judged
MAX_PIXELS = 1 << 26  # of a camera's picture at modelled size, which a viewer may have to paint
LARGEST_VALUE = 1e9  # of a Gaussian; one with a larger number is left out
SH_BASES = (1, 4, 9, 16)  # of degrees 0 to 3
LEAST_BOUND = 1e-9  # that is not 0, in degrees, per cent, or the unit of the world
MAX_CAMERAS = 1000  # of a message: bounds what a hostile one can make a viewer allocate
GAUSSIAN_FIELDS = ("means", "quats", "scales", "opacities", "sh", "source_frame")

Pixels = Annotated[int, msgspec.Meta(ge=1, le=LARGEST_SIDE)]
Matrix4 = Annotated[tuple[Finite, ...], msgspec.Meta(min_length=16, max_length=16)]
Names = Annotated[tuple[Name, ...], msgspec.Meta(max_length=MAX_NAMES)]
Vector3 = tuple[Finite, Finite, Finite]
Matrix3 = Annotated[tuple[Finite, ...], msgspec.Meta(min_length=9, max_length=9)]


class BoundsRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A Bounds. Each is 0, or a number that can be reckoned with: nobody knows a camera as exactly as LEAST_BOUND."""

    rotation_deg: Amount
    centre: Amount
    centre_percent: Amount
    focal_percent: Amount
    axes: tuple[Vector3, Vector3, Vector3]

    def __post_init__(self) -> None:
        """Raises ValueError, of which msgspec makes its own error."""
        for number in (self.rotation_deg, self.centre, self.centre_percent, self.focal_percent):
            if 0.0 < number < LEAST_BOUND:
                raise ValueError(f"a bound must be 0 or at least {LEAST_BOUND:g}, got {number:g}")


class GivenRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A GivenCameraPose."""

    T_world_camera: Matrix4  # row by row
    sigma_m: Amount
    sigma_deg: Amount


class CameraRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A CameraEstimate, which can be looked through: a rigid motion, and a lens with a picture."""

    name: Name
    frame_id: Count
    T_world_camera: Matrix4  # row by row
    K: Matrix3  # row by row
    width: Pixels
    height: Pixels
    bounds: BoundsRecord | None
    captured_at: Stamp | None = None
    lens: Intrinsics | UnsetType = UNSET  # estimated, whose distortion was taken out; left out where nothing was
    camera_id: Name | UnsetType = UNSET  # of several cameras; left out where there is one
    frame_set: Count | UnsetType = UNSET  # the images that were taken together have one; left out where nothing tells
    given: GivenRecord | UnsetType = UNSET  # left out where no pose was given

    def __post_init__(self) -> None:
        """Raises ValueError, of which msgspec makes its own error, where nothing can be seen through it."""
        T_world_camera, K = np.array(self.T_world_camera).reshape(4, 4), np.array(self.K).reshape(3, 3)
        why = find_camera_problem(T_world_camera, K, self.width, self.height)
        if not why and not isinstance(self.given, UnsetType):
            why = find_camera_problem(np.array(self.given.T_world_camera).reshape(4, 4), K, self.width, self.height)
        if not why and self.width * self.height > MAX_PIXELS:
            why = f"a picture of {self.width} x {self.height} pixels, more than {MAX_PIXELS}"
        if why:
            raise ValueError(f"camera {self.name[:60]!a}: {why}")


class ReferenceFrameRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A ReferenceFrame."""

    name: FrameName
    source: Text | None  # how it is known
    sigma_deg: Amount | None  # of an upright one: standard deviation of its z axis
    T_frame_first_camera: Matrix4  # row by row

    def __post_init__(self) -> None:
        """Raises ValueError, of which msgspec makes its own error."""
        if problem := find_frame_problem(np.array(self.T_frame_first_camera).reshape(4, 4)):
            raise ValueError(problem)


class ScaleRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A Scale."""

    metric: bool  # lengths are metres: a unit has one
    source: Text | None  # of the metres, or why there are none although they were asked for
    interval_95: tuple[Amount, Amount] | None  # of metres: a true length is that many times the stated one
    frame: ReferenceFrameRecord | UnsetType = UNSET  # of all coordinates; left out where it is the first camera's


class SceneHeader(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    scene_id: Name  # another one is another place
    code: Code
    message: Text
    advice: Text
    frames: Names
    publishable: bool
    provisional: bool  # evidence is still to be looked at
    cameras: Annotated[tuple[CameraRecord, ...], msgspec.Meta(max_length=MAX_CAMERAS)]
    dropped: Annotated[tuple[tuple[Name, Text], ...], msgspec.Meta(max_length=MAX_DROPPED)]  # name, reason
    iterations: Count
    seconds: Annotated[dict[Name, Amount], msgspec.Meta(max_length=64)]
    final: bool
    # Left out of a relative scene in the first camera's frame of which nothing is to be said
    scale: ScaleRecord | UnsetType = UNSET
    depth_checks: Annotated[tuple[DepthCheckRecord, ...], msgspec.Meta(max_length=MAX_DEPTH_CAMERAS)] | UnsetType = (
        UNSET  # left out where no depth images came
    )


@dataclass(frozen=True, eq=False)
class LiveScene:
    """A scene as a viewer receives it. `images` are thumbnails, `sequence` counts the snapshots."""

    snapshot: Snapshot
    scene_id: str
    session: str
    mono_ns: int  # of the sender


def encode_snapshot(
    snapshot: Snapshot, scene_id: str, numbering: Mapping[str, object]
) -> tuple[SceneHeader, list[npt.NDArray]]:
    """The header and the arrays of a snapshot; `numbering` is session, sequence and mono_ns."""
    verdict = snapshot.verdict
    header = SceneHeader(
        **numbering,  # pyright: ignore[reportArgumentType]
        scene_id=scene_id,
        code=verdict.code,
        message=sanitize_text(verdict.message),
        advice=sanitize_text(verdict.advice),
        frames=verdict.frames[:MAX_NAMES],
        publishable=verdict.publishable,
        provisional=verdict.provisional,
        cameras=tuple(make_camera_record(camera) for camera in snapshot.cameras),
        dropped=tuple(
            (sanitize_text(frame.name, LONGEST_NAME) or "?", sanitize_text(frame.reason))
            for frame in snapshot.dropped[-MAX_DROPPED:]
        ),
        iterations=snapshot.iterations,
        seconds=snapshot.seconds,
        final=snapshot.final,
        scale=UNSET if snapshot.scale == RELATIVE else make_scale_record(snapshot.scale),
        depth_checks=tuple(map(make_depth_check_record, snapshot.depth_checks[:MAX_DEPTH_CAMERAS])) or UNSET,
    )
    thumbnails = [
        make_jpeg_array(make_thumbnail(snapshot.images[camera.name]), THUMBNAIL_QUALITY) for camera in snapshot.cameras
    ]
    return header, [*(getattr(snapshot.gaussians, name) for name in GAUSSIAN_FIELDS), *thumbnails]


def decode_snapshot(message: Message[SceneHeader]) -> LiveScene:
    """The scene in a message. Raises WireError where arrays and header do not belong together."""
    with guard_untrusted(WireError, "a scene"):
        return _decode_live_scene(message)


def _decode_live_scene(message: Message[SceneHeader]) -> LiveScene:
    header = message.header
    gaussians = _parse_gaussians(message.arrays[: len(GAUSSIAN_FIELDS)])
    thumbnails = message.arrays[len(GAUSSIAN_FIELDS) :]
    if len(thumbnails) != len(header.cameras):
        raise WireError(f"{len(header.cameras)} cameras with {len(thumbnails)} thumbnails")
    snapshot = Snapshot(
        sequence=header.sequence,
        verdict=Verdict(
            header.code,
            header.message,
            header.advice,
            header.frames,
            publishable=header.publishable,
            provisional=header.provisional,
        ),
        cameras=tuple(parse_camera(record) for record in header.cameras),
        gaussians=gaussians,
        images={
            record.name: decode_jpeg(jpeg, THUMBNAIL_SIDE)
            for record, jpeg in zip(header.cameras, thumbnails, strict=True)
        },
        dropped=tuple(DroppedFrame(name, reason) for name, reason in header.dropped),
        iterations=header.iterations,
        seconds=header.seconds,
        final=header.final,
        scale=RELATIVE if header.scale is UNSET else parse_scale(header.scale),
        depth_checks=() if header.depth_checks is UNSET else tuple(each.restore() for each in header.depth_checks),
    )
    return LiveScene(snapshot, header.scene_id, header.session, header.mono_ns)


def make_thumbnail(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """(h, w, 3) with the longer side at most THUMBNAIL_SIDE."""
    scale = min(1.0, THUMBNAIL_SIDE / max(image.shape[:2]))
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def make_scale_record(scale: Scale) -> ScaleRecord:
    source = None if scale.source is None else sanitize_text(scale.source)
    return ScaleRecord(scale.metric, source, scale.interval_95, _make_frame_record(scale.frame))


def parse_scale(record: ScaleRecord) -> Scale:
    return Scale(record.metric, record.source, record.interval_95, _parse_frame(record.frame))


def _make_frame_record(frame: ReferenceFrame) -> ReferenceFrameRecord | UnsetType:
    if frame == FIRST_CAMERA:
        return UNSET
    source = None if frame.source is None else sanitize_text(frame.source)
    return ReferenceFrameRecord(frame.name, source, frame.sigma_deg, frame.T_frame_first_camera)


def _parse_frame(record: ReferenceFrameRecord | UnsetType) -> ReferenceFrame:
    return FIRST_CAMERA if isinstance(record, UnsetType) else ReferenceFrame(**msgspec.structs.asdict(record))


def make_bounds_record(bounds: Bounds | None) -> BoundsRecord | None:
    """A bound that is too small to be told is told as the least one, which holds, too."""
    if bounds is None:
        return None
    numbers = {
        name: max(value, LEAST_BOUND) if name != "axes" and value else value for name, value in asdict(bounds).items()
    }
    return BoundsRecord(**numbers)


def parse_bounds(record: BoundsRecord | None) -> Bounds | None:
    return None if record is None else Bounds(**msgspec.structs.asdict(record))


def make_camera_record(camera: CameraEstimate) -> CameraRecord:
    return CameraRecord(
        name=camera.name,
        frame_id=camera.frame_id,
        T_world_camera=tuple(camera.T_world_camera.ravel().tolist()),
        K=tuple(camera.K.ravel().tolist()),
        width=camera.width,
        height=camera.height,
        bounds=make_bounds_record(camera.bounds),
        captured_at=camera.captured_at,
        lens=make_optional_field(camera.lens),
        camera_id=camera.camera_id or UNSET,
        frame_set=make_optional_field(camera.frame_set),
        given=make_given_record(camera.given),
    )


def parse_camera(record: CameraRecord) -> CameraEstimate:
    return CameraEstimate(
        name=record.name,
        frame_id=record.frame_id,
        T_world_camera=np.array(record.T_world_camera).reshape(4, 4),
        K=np.array(record.K).reshape(3, 3),
        width=record.width,
        height=record.height,
        bounds=parse_bounds(record.bounds),
        captured_at=record.captured_at,
        lens=read_optional_field(record.lens),
        camera_id=read_optional_field(record.camera_id) or "",
        frame_set=read_optional_field(record.frame_set),
        given=parse_given(record.given),
    )


def make_given_record(given: GivenCameraPose | None) -> GivenRecord | UnsetType:
    if given is None:
        return UNSET
    return GivenRecord(tuple(given.T_world_camera.ravel().tolist()), given.sigma_m, given.sigma_deg)


def parse_given(record: GivenRecord | UnsetType) -> GivenCameraPose | None:
    if isinstance(record, UnsetType):
        return None
    return GivenCameraPose(np.array(record.T_world_camera).reshape(4, 4), record.sigma_m, record.sigma_deg)


def _parse_gaussians(arrays: tuple[npt.NDArray, ...]) -> GaussianArrays:
    if len(arrays) != len(GAUSSIAN_FIELDS):
        raise WireError(f"{len(arrays)} arrays of Gaussians, expected {', '.join(GAUSSIAN_FIELDS)}")
    count = len(arrays[0]) if arrays[0].ndim else 0
    bases = arrays[4].shape[1] if arrays[4].ndim == 3 else 0
    if bases not in SH_BASES:
        raise WireError(f"sh must have {', '.join(map(str, SH_BASES))} bases, got {arrays[4].shape}")
    expected = [(count, 3), (count, 4), (count, 3), (count,), (count, bases, 3), (count,)]
    for name, array, shape in zip(GAUSSIAN_FIELDS, arrays, expected, strict=True):
        kind = np.int32 if name == "source_frame" else np.float32
        if array.dtype != kind or array.shape != shape:
            raise WireError(f"{name} must be {np.dtype(kind)} {shape}, got {array.dtype} {array.shape}")
    return _drop_unbounded(arrays)


def _drop_unbounded(arrays: tuple[npt.NDArray, ...]) -> GaussianArrays:
    """The Gaussians whose numbers are finite and not absurd."""
    kept = np.ones(len(arrays[0]), bool)
    for array in arrays[:-1]:
        kept &= (np.abs(array) <= LARGEST_VALUE).all(axis=tuple(range(1, array.ndim)))  # not so where it is nan
    return GaussianArrays(*arrays) if kept.all() else GaussianArrays(*(array[kept] for array in arrays))


# The share of multi-view consistent depth as a message of its own, beside that of the scene.
#
# A receiver that is older than the share refuses a scene with a field that it does not know; this message it never
# asks for. Who knows both joins them by the scene's session and sequence.

Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class DepthHeader(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How much of a scene several views measured."""

    scene_id: Name
    scene_sequence: Sequential  # of the message of recon.scene that it is about, in this session
    consistent_depth: Share | None  # of all pixels; None: not known
    views: Annotated[tuple[tuple[Name, Share], ...], msgspec.Meta(max_length=MAX_CAMERAS)]  # name, share; where known


def make_depth_header(
    snapshot: Snapshot, scene_id: str, scene_sequence: int, numbering: Mapping[str, object]
) -> DepthHeader:
    """The message on a snapshot that is shown by message `scene_sequence`; `numbering` as for `encode_snapshot`."""
    shares = ((camera.name, camera.consistent_depth) for camera in snapshot.cameras)
    return DepthHeader(
        **numbering,  # pyright: ignore[reportArgumentType]
        scene_id=scene_id,
        scene_sequence=scene_sequence,
        consistent_depth=snapshot.consistent_depth,
        views=tuple((name, share) for name, share in shares if share is not None)[:MAX_CAMERAS],
    )


def add_depth_shares(snapshot: Snapshot, header: DepthHeader) -> Snapshot:
    """The snapshot of the scene that `header` is about, with what it says of each view."""
    shares = dict(header.views)
    cameras = tuple(replace(camera, consistent_depth=shares.get(camera.name)) for camera in snapshot.cameras)
    return replace(snapshot, cameras=cameras)
