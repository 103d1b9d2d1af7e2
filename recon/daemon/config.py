"""The configuration of the recon daemon, with defaults and units."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from splatnode.capture.messaging.network import Network
from splatnode.capture.process.former_names import NODE_KEYS
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon.free_space import OccupancyConfig as FreeSpace
from splatnode.recon.daemon.ingest import FrameSetConfig
from splatnode.recon.daemon.relocalization import LocatorConfig
from splatnode.recon.daemon.relocalization import TrackingConfig as Tracking
from splatnode.recon.result.message import MAX_CAMERAS

Positive = Annotated[int, msgspec.Meta(ge=1)]


class DaemonConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    former_keys = NODE_KEYS

    network: Network = Network()  # the same as in capture's configuration
    reconstruction: ReconstructionConfig = ReconstructionConfig()
    tracking: Tracking = Tracking()  # localization of the live camera in a final submap
    occupancy: FreeSpace = FreeSpace()  # the occupancy map: which space is free, occupied, or not seen
    localization: LocatorConfig = LocatorConfig()  # of images that clients send
    frame_sets: FrameSetConfig = FrameSetConfig()  # keyframes that several cameras took together
    # Over tcp, network.first_port of each capture beside the first. On one machine recon finds all captures by itself
    further_captures: tuple[Annotated[int, msgspec.Meta(ge=1, le=65500)], ...] = ()
    # Folder that a restart resumes from. None: the folder recon in $STATE_DIRECTORY, else in $XDG_STATE_HOME/splatnode,
    # else in ~/.local/state/splatnode.
    checkpoint: Path | None = None
    out: Path = Path("out")  # folder of the results: each submap is a folder in it, scene-0001 and so on
    # Keyframes of a submap, at most. The next submap begins with a further one and the newest third; where these make
    # no scene, the most redundant keyframe is removed. Higher: fewer, larger submaps, more time for each keyframe.
    max_views: Annotated[int, msgspec.Meta(ge=4, le=MAX_CAMERAS)] = 30
    max_gaussians: Positive = 300_000  # of a submap, at most; `reconstruction.max_gaussians` may be lower
    # Idle finalize: after so long without a keyframe the active submap is verified and rebuilt from all its keyframes,
    # for which a new keyframe waits some seconds.
    idle_finalize_s: Annotated[float, msgspec.Meta(ge=0)] = 3.0
    # So many untracked keyframes in a row begin a new submap. Higher: poor keyframes begin none, but a new submap
    # begins later.
    new_submap_after: Annotated[int, msgspec.Meta(ge=3)] = 3
    # Time for all fallbacks while a submap is finalized. Higher: more weakly matched keyframes, and final later
    fallback_timeout_s: Annotated[float, msgspec.Meta(ge=0)] = 20.0
    export_interval_s: Annotated[float, msgspec.Meta(gt=0)] = 60.0  # between provisional results, while a submap grows
    # Between messages on the state of the process, which `splatnode status` shows
    status_interval_s: Annotated[float, msgspec.Meta(gt=0)] = 1.0

    @property
    def frame_set_tolerance_s(self) -> float:
        """Between images that were taken together, for all that the node does, seconds."""
        own = self.frame_sets.tolerance_s
        return self.reconstruction.frame_set_tolerance_s if own is None else own
