"""The result folder of a snapshot, with its report and a preview."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from splatnode.recon.result.depth_file import DEPTHS, encode_depths
from splatnode.recon.result.export import sanitize_gaussians, write_result
from splatnode.recon.result.export.sources import SOURCES, encode_sources
from splatnode.recon.result.landmarks_file import LANDMARKS, encode_landmarks
from splatnode.recon.result.preview import make_contact_sheet
from splatnode.recon.result.report import build_report, peak_rss_mb
from splatnode.recon.result.snapshot import Snapshot


def write_result_folder(
    snapshot: Snapshot,
    out: Path,
    *,
    seed: int,
    preset_name: str,
    photographs: Mapping[str, bytes] = MappingProxyType({}),
    told: Mapping[str, object] = MappingProxyType({}),
) -> dict[str, object]:
    """Writes the result folder and returns its report, of which `told` is a part.

    `photographs` are files that a scene has beside it, by their names in the folder. Raises ResultWriteError, with what
    was there before intact.
    """
    report = build_report(snapshot, seed=seed, preset=preset_name, peak_rss_mb=peak_rss_mb()) | dict(told)
    preview = make_contact_sheet(snapshot) if snapshot.verdict.publishable else None
    source_frame = sanitize_gaussians(snapshot.gaussians).source_frame  # of those that scene.ply holds
    further = {SOURCES: encode_sources(source_frame), **photographs} if snapshot.verdict.publishable else {}
    if snapshot.verdict.publishable and snapshot.landmarks is not None:
        further[LANDMARKS] = encode_landmarks(snapshot.landmarks)
    if snapshot.verdict.publishable and snapshot.depths:
        further[DEPTHS] = encode_depths(snapshot.depths)
    write_result(snapshot, out, report, preview=preview, further=further)
    return report
