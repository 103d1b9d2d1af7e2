"""One reconstruction for the benchmark `growth`: `python growth_run.py PHOTOGRAPHS PRESET` prints a line of JSON.

The functions that find the cameras are timed one by one: a report tells their sum.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

from splatnode.capture.cameras import folder
from splatnode.recon import estimation, pipeline
from splatnode.recon.config import preset
from splatnode.recon.result.report import peak_rss_mb

TIMED = (
    (pipeline, "prepare", "features"),
    (pipeline, "match", "matching"),
    (estimation, "register", "mapping"),
    (estimation, "verify", "verification"),
)


def timed(function: Callable, seconds: dict[str, float], stage: str) -> Callable:
    """The function, whose seconds are added to those of the stage."""

    def call(*args: object, **kwargs: object) -> object:
        began = time.monotonic()
        try:
            return function(*args, **kwargs)
        finally:
            seconds[stage] = seconds.get(stage, 0.0) + time.monotonic() - began

    return call


def main() -> None:
    photographs, preset_name = Path(sys.argv[1]), sys.argv[2]
    seconds: dict[str, float] = {stage: 0.0 for _, _, stage in TIMED}
    for module, name, stage in TIMED:
        setattr(module, name, timed(getattr(module, name), seconds, stage))
    first, last = None, None
    for last in pipeline.reconstruct(folder.stream(folder.Config(folder=photographs)), preset(preset_name)):
        if first is None and len(last.gaussians):
            first = last.seconds["total"]
    assert last is not None  # there is always a last snapshot
    booked = last.seconds
    seconds |= {"poses": booked.get("poses", 0.0), "points": booked.get("points", 0.0)}
    seconds |= {"refinement": booked.get("optimise", 0.0), "total": booked["total"]}
    row = {"verdict": last.verdict.code.value, "cameras": len(last.cameras), "num_gaussians": len(last.gaussians)}
    print(json.dumps({**row, "seconds": seconds, "first_scene_s": first, "peak_rss_mb": peak_rss_mb()}))


if __name__ == "__main__":
    main()
