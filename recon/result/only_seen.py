"""only_seen: a snapshot without its guesses."""

from __future__ import annotations

from dataclasses import replace

from splatnode.recon.result.export.prepare import select_gaussians
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.sources import find_confirmed


def remove_unconfirmed(snapshot: Snapshot) -> Snapshot:
    """The snapshot without Gaussians at depths that no two photographs confirm, and without the far shell."""
    return replace(
        snapshot, gaussians=select_gaussians(snapshot.gaussians, find_confirmed(snapshot.gaussians.source_frame))
    )
