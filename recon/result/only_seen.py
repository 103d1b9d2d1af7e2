"""only_seen: a snapshot without its guesses."""

from __future__ import annotations

from dataclasses import replace

from splatnode.recon.result.export.prepare import take
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.sources import seen


def only_seen(snapshot: Snapshot) -> Snapshot:
    """The snapshot without Gaussians at depths that no two photographs confirm, and without the far shell."""
    return replace(snapshot, gaussians=take(snapshot.gaussians, seen(snapshot.gaussians.source_frame)))
