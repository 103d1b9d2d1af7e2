"""The configuration of the recon daemon, with defaults and units."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from splatnode.capture.messaging.network import Network
from splatnode.recon.config import Config as Reconstruction
from splatnode.recon.daemon.tracking import Config as Tracking
from splatnode.recon.result.message import MAX_CAMERAS

Positive = Annotated[int, msgspec.Meta(ge=1)]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    network: Network = Network()
    reconstruction: Reconstruction = Reconstruction()
    tracking: Tracking = Tracking()  # of the live camera against a finished scene
    checkpoint: Path | None = None  # None: recon/ in state_directory() of capture/process
    out: Path = Path("out")  # the result of each place is a folder in it: scene-0001, ...
    # Beyond, the view that has most in common with another goes.
    max_views: Annotated[int, msgspec.Meta(ge=4, le=MAX_CAMERAS)] = 30
    max_gaussians: Positive = 300_000
    # Without a keyframe, until the whole scene is verified and built anew. A verification takes seconds for which a
    # keyframe would have to wait: with one every two seconds there is no time for it.
    settle_s: Annotated[float, msgspec.Meta(ge=0)] = 3.0
    lost_after: Annotated[int, msgspec.Meta(ge=3)] = 3  # so many keyframes in a row that do not fit begin a new place
    export_every_s: Annotated[float, msgspec.Meta(gt=0)] = 60.0  # provisional results, while the scene grows
    status_every_s: Annotated[float, msgspec.Meta(gt=0)] = 1.0
