"""What can be configured in the recon daemon, with defaults and units."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from splatnode.capture.messaging.network import Network
from splatnode.recon.config import Config as Reconstruction
from splatnode.recon.daemon.tracking import Config as Tracking

Positive = Annotated[int, msgspec.Meta(ge=1)]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    network: Network = Network()
    reconstruction: Reconstruction = Reconstruction()
    tracking: Tracking = Tracking()  # of the live camera against a finished scene
    checkpoint: Path | None = None  # None: recon/ in splatnode.capture.process.state_directory
    out: Path = Path("out")  # each place becomes a folder in it
    max_views: Annotated[int, msgspec.Meta(ge=4)] = 30  # beyond, those that others show too are given up
    max_gaussians: Positive = 300_000
    # Without a keyframe, until all evidence is weighed and the scene made afresh. A verification takes seconds that a
    # keyframe would have to wait; with one every two seconds there is no time for it.
    settle_s: Annotated[float, msgspec.Meta(ge=0)] = 3.0
    lost_after: Annotated[int, msgspec.Meta(ge=3)] = 3  # keyframes in a row that do not fit: a new place
    status_every_s: Annotated[float, msgspec.Meta(gt=0)] = 1.0
