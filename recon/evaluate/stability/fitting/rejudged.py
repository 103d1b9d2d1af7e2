"""Rows of windows.json under numbers that were fitted without their scene: what the published figures count."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from splatnode.recon.evaluate.stability.claim import ROUGH
from splatnode.recon.evaluate.stability.fitting.judge import claimed, judged, published
from splatnode.recon.evaluate.stability.fitting.samples import Sample, of_window
from splatnode.recon.evaluate.stability.windows.row import Row
from splatnode.recon.result.verdict import Code
from splatnode.recon.verification.models import Numbers

REFUSED = Code.AMBIGUOUS.value  # stands for whatever the verdict would have said


def rejudged(rows: Sequence[Row], numbers: Mapping[str, Numbers]) -> list[Row]:
    """`numbers` by the scene that they were fitted without; rows of which nothing was registered stay as they are."""
    return [_rejudged(row, of_window(row), numbers) if row.evidence is not None else row for row in rows]


def _rejudged(row: Row, sample: Sample, by_scene: Mapping[str, Numbers]) -> Row:
    if sample.pair or row.scene not in by_scene:
        return row
    numbers = by_scene[row.scene]
    exact, cameras = judged(sample, numbers).exact, claimed(sample, numbers)
    if published(sample, numbers):
        verdict = (Code.OK.value if sample.whole else Code.OK_PARTIAL.value) if exact else ROUGH
        return replace(row, published=True, verdict=verdict, cameras=cameras)
    return replace(row, published=False, verdict=REFUSED if row.published else row.verdict, cameras=cameras)
