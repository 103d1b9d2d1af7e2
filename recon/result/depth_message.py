"""The share of multi-view consistent depth as a message of its own, beside that of the scene.

A receiver that is older than the share refuses a scene with a field that it does not know; this message it never asks
for. Who knows both joins them by the scene's session and sequence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated

import msgspec

from splatnode.capture.messaging.values import Name, Sequential
from splatnode.capture.messaging.wire import Header
from splatnode.recon.result.message import MAX_CAMERAS
from splatnode.recon.result.snapshot import Snapshot

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
