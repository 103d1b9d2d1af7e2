"""The configuration of the recon daemon, with defaults and units."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from splatnode.capture.messaging.network import Network
from splatnode.recon.config import ReconstructionConfig as Reconstruction
from splatnode.recon.daemon.captures import FrameSetConfig
from splatnode.recon.daemon.free_space import OccupancyConfig as FreeSpace
from splatnode.recon.daemon.relocalization import TrackingConfig as Tracking
from splatnode.recon.result.message import MAX_CAMERAS

Positive = Annotated[int, msgspec.Meta(ge=1)]


class DaemonConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    network: Network = Network()  # the same as in capture's configuration
    reconstruction: Reconstruction = Reconstruction()
    tracking: Tracking = Tracking()  # of the live camera against a finished scene
    map: FreeSpace = FreeSpace()  # which space is free, occupied, or not seen
    frame_sets: FrameSetConfig = FrameSetConfig()  # keyframes that several cameras took together
    # Over tcp, network.first_port of each capture beside the first. On one machine recon finds all captures by itself
    further_captures: tuple[Annotated[int, msgspec.Meta(ge=1, le=65500)], ...] = ()
    # What a restart goes on from. None: the folder recon in $STATE_DIRECTORY, else in $XDG_STATE_HOME/splatnode, else
    # in ~/.local/state/splatnode.
    checkpoint: Path | None = None
    out: Path = Path("out")  # folder of the results: each place is a folder in it, scene-0001 and so on
    # Photographs in a scene, at most. When a further one fits, the next scene goes on with it and the newest third, and
    # the full one is finished as a place that was left; where the newest alone make no scene, the photograph that has
    # most in common with another goes. Higher: fewer, larger scenes, and more time for each keyframe.
    max_views: Annotated[int, msgspec.Meta(ge=4, le=MAX_CAMERAS)] = 30
    max_gaussians: Positive = 300_000  # of a scene, at most; `reconstruction.max_gaussians` may be lower
    # After so long without a keyframe the whole scene is verified and made anew from all photographs. That takes
    # seconds for which a keyframe would have to wait: with one every two seconds there is no time for it.
    settle_s: Annotated[float, msgspec.Meta(ge=0)] = 3.0
    # So many keyframes in a row that do not fit the scene begin a scene of their own, as another place. Higher: a few
    # poor keyframes begin none, but more keyframes of another place are taken before its scene begins.
    lost_after: Annotated[int, msgspec.Meta(ge=3)] = 3
    # How long making a scene final may look for further matches, all rounds together: what does not belong to the scene
    # is tried with it in several ways. Higher: a place of weak matches may keep more keyframes, and is final later
    fallback_s: Annotated[float, msgspec.Meta(ge=0)] = 20.0
    export_every_s: Annotated[float, msgspec.Meta(gt=0)] = 60.0  # between provisional results, while the scene grows
    # Between messages that say how the process is, which `splatnode status` shows
    status_every_s: Annotated[float, msgspec.Meta(gt=0)] = 1.0
