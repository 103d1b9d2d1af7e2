"""Registrations with known truth, as windows.json and stability.json keep them, published or not."""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from splatnode.capture.process.records import record_of
from splatnode.extras.evaluate.stability.case import CameraError, has_only_right_cameras, make_finite_bounds
from splatnode.extras.evaluate.stability.windows.windows import OURS, WindowRow
from splatnode.recon.result.verdict import Code
from splatnode.recon.verification.config import DecisionConfig
from splatnode.recon.verification.decision import LIMITS, EvidenceCase
from splatnode.recon.verification.error_model import VerdictModel, compute_log_odds
from splatnode.recon.verification.evidence import Evidence, find_non_finite

CLEAN = "clean"  # the kind of trials of `lens_assumptions` that break nothing
GROSS_SPREAD_PCT = 20.0  # of the true centres' spread


@dataclass(frozen=True, eq=False)
class Sample:
    """One registration, with what was evidence for it and how wrong it is."""

    scene: str  # samples of one scene are left out together
    count: int  # photographs
    window: bool  # of windows.json; else of the matrix
    whole: bool  # every photograph has a camera
    stood_still: bool  # the pairs alone refused it: the camera only turned, or not even that
    evidence: Evidence
    errors: Mapping[str, CameraError]  # by camera; of those that have a true one
    broken: bool = False  # its images break what is assumed of lenses, on purpose: a trial of `lens_assumptions`
    told: bool = False  # what EXIF or a calibration says of the lens came with the photographs of a window

    @property
    def is_pair(self) -> bool:
        """Two cameras have numbers of their own."""
        return len(self.evidence.cameras) == 2

    @property
    def own_lens(self) -> bool:
        """Whether any image has a lens that is not what it was taken for."""
        return any(camera.own_lens for camera in self.evidence.cameras)

    @property
    def is_one_world(self) -> bool:
        """Whether all cameras are of one world; those of several are wrong whatever is claimed of them."""
        return len(self.errors) == len(self.evidence.cameras)

    @property
    def right(self) -> bool:
        return self.is_one_world and has_only_right_cameras(list(self.errors.values()))

    @property
    def is_gross(self) -> bool:
        """Wrong beyond what any claim should allow; motion where there was none is, too."""
        return not self.is_one_world or any(
            error.centre_pct is None or error.is_far or (error.spread_pct or 0.0) > GROSS_SPREAD_PCT
            for error in self.errors.values()
        )


def load_results(path: Path) -> dict[str, Any]:
    """The JSON of a file, which may be compressed (.gz)."""
    data = path.read_bytes()
    return json.loads(gzip.decompress(data) if path.suffix == ".gz" else data)


def read_samples(paths: list[Path]) -> list[Sample]:
    """All samples. Raises ValueError for a file that is neither of the two."""
    found = []
    for path in paths:
        content = load_results(path)
        if "rows" in content:
            rows = record_of(content["rows"], list[WindowRow])
            told = content.get("told", "nothing") != "nothing"
            windows = (make_window_sample(row) for row in rows if row.method == OURS and row.evidence is not None)
            found += [replace(window, told=told) for window in windows]
        elif "trials" in content:
            found += list(make_trial_samples(content["trials"]))
        else:
            raise ValueError(f"{path} must be a windows.json or a stability.json, it has {', '.join(content)}")
    return found


def make_window_sample(row: WindowRow) -> Sample:
    """The sample of a row that has evidence."""
    evidence = _parse_evidence(dict(row.evidence or {}))
    whole = len(evidence.cameras) == row.count
    errors = {error.name: error for error in row.cameras}
    return Sample(row.scene, row.count, True, whole, _is_still(row.published, row.verdict), evidence, errors)


def make_trial_samples(trials: list[dict]) -> Iterator[Sample]:
    """Yields the sample of each trial of ours that has evidence."""
    for trial in trials:
        if trial["method"] == OURS and trial.get("evidence") is not None:
            evidence = _parse_evidence(trial["evidence"])
            scene = trial["note"].split(",")[0].split(" and ")[0]
            still, errors = _is_still(trial["published"], trial["verdict"]), _parse_errors(trial["errors"])
            yield Sample(scene, len(evidence.cameras), False, True, still, evidence, errors, broken=_is_broken(trial))


def _is_broken(trial: dict) -> bool:
    return trial.get("kind", CLEAN) != CLEAN


def _is_still(published: bool, verdict: str) -> bool:
    return not published and verdict in (Code.NO_PARALLAX.value, Code.STATIC_CAMERA.value)


def _parse_errors(records: list[dict]) -> dict[str, CameraError]:
    return {record["name"]: record_of(record, CameraError) for record in records}


def _parse_evidence(record: dict[str, Any]) -> Evidence:
    """The evidence of a report, in which None stands for a number that was not finite."""
    return record_of({name: _replace_none(value) for name, value in record.items() if name != "log_odds"}, Evidence)


def _replace_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _replace_none(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_replace_none(each) for each in value]
    return math.nan if value is None else value


# What the verdict would be of a sample under other numbers, by the checks that ask the evidence alone.


def judge_sample(sample: Sample, numbers: VerdictModel) -> EvidenceCase:
    return EvidenceCase(sample.evidence, DecisionConfig(), numbers)


def passes_limits(sample: Sample, numbers: VerdictModel) -> bool:
    """Whether nothing refuses it but the odds."""
    case = judge_sample(sample, numbers)
    if sample.stood_still:
        return False
    finite = not any(find_non_finite(sample.evidence))
    return finite and all(check(case) is None for check in LIMITS) and case.is_usable


def is_published(sample: Sample, numbers: VerdictModel) -> bool:
    odds = compute_log_odds(sample.evidence, numbers.claims, numbers.odds)
    return odds.total >= DecisionConfig().min_log_odds and passes_limits(sample, numbers)


def is_wrong(sample: Sample, numbers: VerdictModel) -> bool:
    """Grossly wrong; or not right, and beyond the claim."""
    return sample.is_gross or (not sample.right and exceeds_bounds(sample, numbers))


def exceeds_bounds(sample: Sample, numbers: VerdictModel) -> bool:
    """Beyond 2.5 times a bound; or beyond 5 degrees or 10 % of the distance, and said to be exact."""
    rough = not judge_sample(sample, numbers).is_exact
    return not sample.is_one_world or any(error.is_wrong(rough) for error in attach_bounds(sample, numbers))


def attach_bounds(sample: Sample, numbers: VerdictModel) -> tuple[CameraError, ...]:
    """The errors, each beside the bounds that these numbers give its camera."""
    bounds = judge_sample(sample, numbers).bounds
    return tuple(replace(error, bounds=make_finite_bounds(bounds[name])) for name, error in sample.errors.items())
