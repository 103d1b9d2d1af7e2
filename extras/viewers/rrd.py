"""A rerun recording: cameras with their photographs, Gaussians, landmarks, and the verdict as text."""

from __future__ import annotations

from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.stored_snapshot import load_full_snapshot

DEFAULT_NAME = "scene.rrd"


def export(result: StoredResult) -> bytes:
    """Raises ModuleNotFoundError without rerun."""
    from splatnode.extras.viewers import rerun  # takes a second, and is an extra

    return rerun.encode_recording(load_full_snapshot(result))
