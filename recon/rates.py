"""How long each step of a growing scene takes on this machine: `splatnode doctor --rates [VIEWS ...]`.

The steps are those of a node and of `splatnode.Session`, measured on the built-in capture: the last image is added and
the scene updated with it, a query image is localized, all is finalized, and the final scene becomes a map.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.capture.process.terminal import Tell, ignore_progress
from splatnode.recon import core
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.locating import Located, NotLocated
from splatnode.recon.locating.localize import localize_image
from splatnode.recon.occupancy import NoMap, occupancy_map
from splatnode.recon.pipeline import rebuild_from_scratch
from splatnode.recon.result.snapshot import Landmarks

VIEWS = (3, 6, 12)
FEWEST, MOST = 2, 48
_QUERIES = 5  # localized images, at most: the median counts

Made = TypeVar("Made")


@dataclass(frozen=True)
class Rates:
    """Seconds of each step of a scene with so many views; None for what was not possible."""

    views: int
    add_s: float  # features and matches of the last image
    update_s: float  # the scene with it
    localize_s: float | None  # a query image, anywhere in the final scene: the median
    localized: str  # how many of the query images were localized: "5 of 5"
    finalize_s: float  # all evidence, and the refined scene
    map_s: float | None  # which space is free; None too where the cameras are too rough for a map
    verdict: str
    gaussians: int


def measure_rates(
    views: Sequence[int] = VIEWS, config: ReconstructionConfig | None = None, tell: Tell = ignore_progress
) -> list[Rates]:
    """Measures the seconds of each step for each number of views. Raises ValueError for less than 2 or more than 48."""
    wrong = [count for count in views if not FEWEST <= count <= MOST]
    if wrong or not views:
        raise ValueError(
            f"--rates must be numbers of views from {FEWEST} to {MOST}, got {wrong[0] if wrong else 'none'}"
        )
    config = config or ReconstructionConfig()
    _measure(FEWEST, config, ignore_progress)  # loads what is loaded once
    return [_measure(count, config, tell) for count in views]


def record_rates(found: Sequence[Rates]) -> dict[str, object]:
    """The rates and the machine, for --json."""
    machine = {"threads": core.default_threads(), "instruction_set": core.instruction_sets()[0]}
    command = f"splatnode doctor --rates {' '.join(str(each.views) for each in found)} --json"
    return {"command": command, "machine": machine, "rates": [asdict(each) for each in found]}


def format_rates(found: Sequence[Rates]) -> list[str]:
    """A table for people, a line for each number of views."""
    titles = ("views", "add", "update", "localize", "finalize", "map")
    rows = [
        (
            str(each.views),
            *map(_format_seconds, (each.add_s, each.update_s, each.localize_s, each.finalize_s, each.map_s)),
        )
        for each in found
    ]
    return ["".join(text.rjust(10) for text in row) for row in (titles, *rows)]


def _measure(count: int, config: ReconstructionConfig, tell: Tell) -> Rates:
    tell(f"measuring a scene of {count} views")
    capture = synthetic.Config(views=count)
    work = IncrementalReconstruction(config)
    *before, last = synthetic.stream(capture)
    for frame in before:
        work.add_frame(frame)
        work.update()
    add_s, _ = _time(lambda: work.add_frame(last))
    update_s, _ = _time(work.update)
    finalize_s, (*_, snapshot) = _time(lambda: list(rebuild_from_scratch(work)))
    tried = _localize(capture, snapshot.landmarks)
    map_s = None
    with suppress(NoMap):
        map_s, _ = _time(lambda: occupancy_map(snapshot))
    return Rates(
        views=count,
        add_s=add_s,
        update_s=update_s,
        localize_s=float(np.median([seconds for seconds, _ in tried])) if tried else None,
        localized=f"{sum(isinstance(outcome, Located) for _, outcome in tried)} of {len(tried)}",
        finalize_s=finalize_s,
        map_s=map_s,
        verdict=snapshot.verdict.code.value,
        gaussians=len(snapshot.gaussians),
    )


def _localize(capture: synthetic.Config, landmarks: Landmarks | None) -> list[tuple[float, Located | NotLocated]]:
    """Seconds and outcomes of query images between those of the scene; none where there is no scene."""
    if landmarks is None:
        return []
    queries = synthetic.evaluation_cameras(capture)[:_QUERIES]
    images = [synthetic.render_image(capture, camera) for camera in queries]
    return [_time(partial(localize_image, landmarks, image, None)) for image in images]


def _time(work: Callable[[], Made]) -> tuple[float, Made]:
    began = time.perf_counter()
    made = work()
    return time.perf_counter() - began, made


def _format_seconds(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds:.2f} s"
