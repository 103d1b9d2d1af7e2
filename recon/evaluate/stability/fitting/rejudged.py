"""Rows of windows.json under numbers that were fitted without their scene: what the published figures count."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from splatnode.recon.evaluate.stability.claim import ROUGH
from splatnode.recon.evaluate.stability.fitting.judge import attach_bounds, is_published, judge_sample
from splatnode.recon.evaluate.stability.fitting.samples import Sample, make_window_sample
from splatnode.recon.evaluate.stability.windows.row import WindowRow
from splatnode.recon.result.verdict import Code
from splatnode.recon.verification.models import VerdictModel

REFUSED = Code.AMBIGUOUS.value  # stands for whatever the verdict would have said


def rejudge_rows(rows: Sequence[WindowRow], numbers: Mapping[str, VerdictModel]) -> list[WindowRow]:
    """`numbers` by the scene that they were fitted without; rows of which nothing was registered stay as they are."""
    return [_rejudge_row(row, make_window_sample(row), numbers) if row.evidence is not None else row for row in rows]


def _rejudge_row(row: WindowRow, sample: Sample, by_scene: Mapping[str, VerdictModel]) -> WindowRow:
    if sample.is_pair or row.scene not in by_scene:
        return row
    numbers = by_scene[row.scene]
    exact, cameras = judge_sample(sample, numbers).is_exact, attach_bounds(sample, numbers)
    if is_published(sample, numbers):
        verdict = (Code.OK.value if sample.whole else Code.OK_PARTIAL.value) if exact else ROUGH
        return replace(row, published=True, verdict=verdict, cameras=cameras)
    return replace(row, published=False, verdict=REFUSED if row.published else row.verdict, cameras=cameras)
