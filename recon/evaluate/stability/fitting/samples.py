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
from splatnode.recon.evaluate.stability.claim import CameraError, all_right
from splatnode.recon.evaluate.stability.windows.row import OURS, Row
from splatnode.recon.result.verdict import Code
from splatnode.recon.verification.evidence import Evidence

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
    def pair(self) -> bool:
        """Two cameras have numbers of their own."""
        return len(self.evidence.cameras) == 2

    @property
    def own_lens(self) -> bool:
        """Whether any image has a lens that is not what it was taken for."""
        return any(camera.own_lens for camera in self.evidence.cameras)

    @property
    def together(self) -> bool:
        """Whether all cameras are of one world; those of several are wrong whatever is claimed of them."""
        return len(self.errors) == len(self.evidence.cameras)

    @property
    def right(self) -> bool:
        return self.together and all_right(list(self.errors.values()))

    @property
    def gross(self) -> bool:
        """Wrong beyond what any claim should allow; motion where there was none is, too."""
        return not self.together or any(
            error.centre_pct is None or error.far or (error.spread_pct or 0.0) > GROSS_SPREAD_PCT
            for error in self.errors.values()
        )


def load(path: Path) -> dict[str, Any]:
    """The JSON of a file, which may be compressed (.gz)."""
    data = path.read_bytes()
    return json.loads(gzip.decompress(data) if path.suffix == ".gz" else data)


def read(paths: list[Path]) -> list[Sample]:
    """All samples. Raises ValueError for a file that is neither of the two."""
    found = []
    for path in paths:
        content = load(path)
        if "rows" in content:
            rows = record_of(content["rows"], list[Row])
            told = content.get("told", "nothing") != "nothing"
            windows = (of_window(row) for row in rows if row.method == OURS and row.evidence is not None)
            found += [replace(window, told=told) for window in windows]
        elif "trials" in content:
            found += list(_of_trials(content["trials"]))
        else:
            raise ValueError(f"{path} must be a windows.json or a stability.json, it has {', '.join(content)}")
    return found


def of_window(row: Row) -> Sample:
    """The sample of a row that has evidence."""
    evidence = _evidence(dict(row.evidence or {}))
    whole = len(evidence.cameras) == row.count
    errors = {error.name: error for error in row.cameras}
    return Sample(row.scene, row.count, True, whole, _still(row.published, row.verdict), evidence, errors)


def _of_trials(trials: list[dict]) -> Iterator[Sample]:
    for trial in trials:
        if trial["method"] == OURS and trial.get("evidence") is not None:
            evidence = _evidence(trial["evidence"])
            scene = trial["note"].split(",")[0].split(" and ")[0]
            still, errors = _still(trial["published"], trial["verdict"]), _errors(trial["errors"])
            yield Sample(scene, len(evidence.cameras), False, True, still, evidence, errors, broken=_is_broken(trial))


def _is_broken(trial: dict) -> bool:
    return trial.get("kind", CLEAN) != CLEAN


def _still(published: bool, verdict: str) -> bool:
    return not published and verdict in (Code.NO_PARALLAX.value, Code.STATIC_CAMERA.value)


def _errors(records: list[dict]) -> dict[str, CameraError]:
    return {record["name"]: record_of(record, CameraError) for record in records}


def _evidence(record: dict[str, Any]) -> Evidence:
    """The evidence of a report, in which None stands for a number that was not finite."""
    return record_of({name: _finite(value) for name, value in record.items() if name != "log_odds"}, Evidence)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return math.nan if value is None else value
