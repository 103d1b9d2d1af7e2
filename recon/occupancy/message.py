"""The map of the present scene as a message; its one array is `states`, as occupancy.npz has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.messaging.wire import Amount, Header, Message, Name, Sequential, Text, WireError
from splatnode.capture.process.text import guard_untrusted, sanitize_text
from splatnode.recon.occupancy.grid import OccupancyMap, Upright, VoxelState
from splatnode.recon.result.message import Matrix4, ScaleRecord, Vector3, make_scale_record, parse_scale
from splatnode.recon.result.snapshot import CameraEstimate, find_camera_problem
from splatnode.recon.result.verdict import find_widest

Side = Annotated[float, msgspec.Meta(ge=1e-9, le=1e9)]


class ProvisionalRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A map of a scene that grows: how sure its cameras are, and in which world it is."""

    revision: Sequential  # of the scene's world: withdrawn once the heartbeat tells a later one
    views: Sequential  # that it is made of
    rotation_deg: Amount | None  # 95 % bound of its least certain camera; None: nobody tells it
    centre: Amount | None  # likewise, in the unit of the map
    centre_percent: Amount | None  # likewise, of the distance to the scene


class MapRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """An OccupancyMap without its states."""

    scene_sequence: Sequential  # of the message of recon.scene, of this session, that shows the scene of the map
    voxel: Side
    origin: Vector3
    T_world_map: Matrix4  # row by row
    up: Text  # how the direction of up is known
    on_floor: bool  # z = 0 is the floor; else it is the height of the first camera
    scale: ScaleRecord
    provisional: ProvisionalRecord | None = None  # left out where the scene is final

    def __post_init__(self) -> None:
        """Raises ValueError, of which msgspec makes its own error, where the map lies nowhere."""
        why = find_camera_problem(np.array(self.T_world_map).reshape(4, 4), np.eye(3), 1, 1)
        if why:
            raise ValueError(why.replace("T_world_camera", "T_world_map"))


class MapHeader(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The current occupancy map; no array comes where there is no map."""

    scene_id: Name
    why: Text  # there is no map; empty where there is one
    map: MapRecord | None


def encode_map(
    occupancy: OccupancyMap,
    scene_id: str,
    scene_sequence: int,
    numbering: Mapping[str, object],
    provisional: ProvisionalRecord | None = None,
) -> tuple[MapHeader, list[npt.NDArray]]:
    """The header and the array of a map; `numbering` is session, sequence and mono_ns."""
    record = MapRecord(
        scene_sequence=scene_sequence,
        voxel=occupancy.voxel,
        origin=tuple(occupancy.origin.tolist()),
        T_world_map=tuple(occupancy.T_world_map.ravel().tolist()),
        up=sanitize_text(occupancy.upright.source),
        on_floor=occupancy.upright.on_floor,
        scale=make_scale_record(occupancy.scale),
        provisional=provisional,
    )
    header = MapHeader(**numbering, scene_id=scene_id, why="", map=record)  # pyright: ignore[reportArgumentType]
    return header, [occupancy.states]


def make_provisional_record(revision: int, cameras: Sequence[CameraEstimate]) -> ProvisionalRecord:
    """The record of a map that was made of these cameras while their scene grew."""
    widest = find_widest(camera.bounds for camera in cameras if camera.bounds is not None)
    if widest is None:
        return ProvisionalRecord(revision, len(cameras), None, None, None)
    return ProvisionalRecord(revision, len(cameras), widest.rotation_deg, widest.centre, widest.centre_percent)


def no_map(scene_id: str, why: str, numbering: Mapping[str, object]) -> MapHeader:
    """The header that takes the map before it back."""
    return MapHeader(**numbering, scene_id=scene_id, why=sanitize_text(why), map=None)  # pyright: ignore[reportArgumentType]


def decode_map(message: Message[MapHeader]) -> OccupancyMap | None:
    """The map in a message; None where it says that there is none. Raises WireError where its array is no map's."""
    with guard_untrusted(WireError, "a map"):
        record, arrays = message.header.map, message.arrays
        if record is None:
            if arrays:
                raise WireError("a message without a map has no array")
            return None
        if len(arrays) != 1 or arrays[0].ndim != 3 or arrays[0].dtype != np.uint8 or not arrays[0].size:
            raise WireError(f"a map has one array, states (X, Y, Z) uint8; got {[each.shape for each in arrays]}")
        if arrays[0].max() > max(VoxelState):
            raise WireError(f"states must be 0 to {int(max(VoxelState))}, got {int(arrays[0].max())}")
        T_world_map = np.array(record.T_world_map).reshape(4, 4)
        frame = Upright(T_world_map, record.up, record.on_floor)
        return OccupancyMap(arrays[0], record.voxel, np.array(record.origin), frame, parse_scale(record.scale))
