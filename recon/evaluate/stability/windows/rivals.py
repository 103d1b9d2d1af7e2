"""COLMAP's and GLOMAP's answers to windows: a scene's features and matches are made once, each window is mapped."""

from __future__ import annotations

import itertools
import multiprocessing
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from multiprocessing.context import ForkServerContext
from pathlib import Path
from tempfile import TemporaryDirectory

from splatnode.capture.frame import Frame
from splatnode.recon.config import Config
from splatnode.recon.evaluate.process import call_alone
from splatnode.recon.evaluate.rivals import colmap
from splatnode.recon.evaluate.rivals.outcome import verdict
from splatnode.recon.evaluate.stability.places import Place
from splatnode.recon.evaluate.stability.stock import camera_estimate
from splatnode.recon.evaluate.stability.windows.row import Answer
from splatnode.recon.evaluate.stability.windows.window import Window

MAPPERS: Mapping[str, colmap.Mapper] = {"colmap": colmap.incremental, "glomap": colmap.global_}
Job = tuple[str, Window]


def answers(
    place: Place, jobs: Sequence[Job], config: Config, fresh: bool, timeout_s: float
) -> Iterator[tuple[Job, Answer]]:
    """One answer for each method and window, each mapped in a process of its own: one that crashes harms no other.

    What is left in memory and on the disk between windows is the scene's features and matches, in a temporary folder.
    """
    if not jobs:
        return
    with TemporaryDirectory(prefix="splatnode-windows-") as name:
        folder = Path(name)
        named = _prepared(folder, place, [window for _, window in jobs], config.seed)
        for number, (method, window) in enumerate(jobs):
            mine = {image: frame for image, frame in named.items() if frame.name in window.names}
            colmap.part(folder, mine.keys(), folder / f"window_{number}")
            mapping = partial(_mapped, folder / f"window_{number}", mine, config.seed, MAPPERS[method])
            from_scratch = partial(_from_scratch, list(mine.values()), config.seed, MAPPERS[method])
            try:
                answer = call_alone(mapping, timeout_s, _context())
                if fresh:
                    answer = replace(answer, fresh_seconds=call_alone(from_scratch, timeout_s, _context()))
            except RuntimeError as error:
                answer = Answer(None, message=str(error))
            yield (method, window), answer


def _prepared(folder: Path, place: Place, windows: Sequence[Window], seed: int) -> dict[str, Frame]:
    """The photographs that any window has, by the names of their images, with features and the pairs of all windows."""
    names = {name for window in windows for name in window.names}
    positions = [i for i, name in enumerate(place.names) if name in names]
    named = colmap.image_names(
        [Frame(i, place.names[i], i, place.scene.image(place.names[i]), None) for i in positions]
    )
    image_of = {frame.name: image for image, frame in named.items()}
    colmap.extract_features(folder, named, seed)
    pairs = {
        (image_of[first], image_of[second])
        for window in windows
        for first, second in itertools.combinations(window.names, 2)
    }
    colmap.match_pairs(folder, sorted(pairs))
    return named


def _mapped(folder: Path, named: Mapping[str, Frame], seed: int, mapper: colmap.Mapper) -> Answer:
    started = time.perf_counter()
    model = colmap.largest_model(folder, named, seed, mapper)
    seconds = time.perf_counter() - started
    found = () if model is None else model.registered
    said = verdict(list(named.values()), {each.frame.name for each in found})
    return Answer(said, tuple(map(camera_estimate, found)), seconds)


def _from_scratch(frames: Sequence[Frame], seed: int, mapper: colmap.Mapper) -> float:
    started = time.perf_counter()
    colmap.sparse_model(frames, seed, mapper)
    return time.perf_counter() - started


def _context() -> ForkServerContext:
    """Processes that find everything imported."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return context
