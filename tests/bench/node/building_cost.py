"""What a long walk costs recon, as a function of the keyframe's number: from samples taken while it ran."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

FROM = 50  # keyframes that are left out of all slopes: the beginning is different
WINDOW = 25  # keyframes of the running median


@dataclass(frozen=True)
class Sample:
    """Of recon, at one moment of the run."""

    second: float
    acknowledged: int  # keyframes that its checkpoint holds
    done: int  # of them, those that it has dealt with
    processor_s: float
    rss_mb: float
    delay_s: float
    checkpoint_mb: float


def cost_row(samples: Sequence[Sample]) -> dict:
    """Seconds a keyframe, memory and disk; slopes by the number of the keyframe. None where there are too few."""
    told: dict = {"keyframes": samples[-1].done if samples else 0}
    for what in ("processor_s", "second"):
        numbers, seconds = per_keyframe(samples, what)
        late = seconds[numbers >= FROM]
        told[what] = {
            "median": _of(np.median, seconds),
            "percentile_95": _of(lambda values: np.percentile(values, 95), seconds),
            "percentile_95_from_50": _of(lambda values: np.percentile(values, 95), late),
            "slope_of_median_per_100": slope_per_100(numbers, seconds),
        }
    late = [sample for sample in samples if FROM <= sample.done < told["keyframes"]]  # while the robot walked
    told["rss_mb"] = {
        "most": max((sample.rss_mb for sample in samples), default=None),
        "growth_per_keyframe": _growth(late, "rss_mb"),
    }
    told["checkpoint_mb"] = {
        "last": samples[-1].checkpoint_mb if samples else None,
        "growth_per_keyframe": _growth(late or samples, "checkpoint_mb"),
    }
    busy = [sample.delay_s for sample in samples if sample.delay_s > 0]
    told["delay_s"] = {"median": _of(np.median, np.array(busy)), "most": max(busy, default=0.0)}
    told["samples"] = [{key: round(value, 2) for key, value in asdict(sample).items()} for sample in samples]
    return told


def per_keyframe(samples: Sequence[Sample], what: str) -> tuple[np.ndarray, np.ndarray]:
    """Keyframe numbers, and what each took: what passed between two samples is shared out to those done between."""
    numbers: list[int] = []
    shares: list[float] = []
    last = None
    for sample in samples:
        if last is not None and sample.done > last.done:
            count = sample.done - last.done
            numbers += range(last.done, sample.done)
            shares += [(getattr(sample, what) - getattr(last, what)) / count] * count
        if last is None or sample.done > last.done:
            last = sample
    return np.array(numbers, int), np.array(shares)


def slope_per_100(numbers: np.ndarray, values: np.ndarray) -> float | None:
    """Of the running median of `values` over 100 keyframes, from keyframe `FROM` on; None for too few of them."""
    late = values[numbers >= FROM]
    if len(late) < 2 * WINDOW:
        return None
    running = [float(np.median(late[start : start + WINDOW])) for start in range(len(late) - WINDOW + 1)]
    return 100 * float(np.polyfit(np.arange(len(running)), running, 1)[0])


def folder_mb(folder: Path) -> float:
    """Megabytes of the files in a folder; what vanishes meanwhile does not count."""
    total = 0
    for path in folder.rglob("*"):
        try:
            total += path.stat().st_size if path.is_file() else 0
        except FileNotFoundError:
            continue
    return total / 1e6


def _growth(samples: Sequence[Sample], what: str) -> float | None:
    done = np.array([sample.done for sample in samples])
    if len(done) < 3 or np.ptp(done) < 10:
        return None
    return float(np.polyfit(done, [getattr(sample, what) for sample in samples], 1)[0])


def _of(measure, values: np.ndarray) -> float | None:
    return float(measure(values)) if len(values) else None
