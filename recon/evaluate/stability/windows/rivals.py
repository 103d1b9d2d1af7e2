"""COLMAP's and GLOMAP's answers to windows: a photograph's features and a pair's matches are found once in a scene."""

from __future__ import annotations

import itertools
import pickle
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from splatnode.capture.frame import Frame
from splatnode.recon.evaluate.rivals import colmap
from splatnode.recon.evaluate.rivals.outcome import make_verdict
from splatnode.recon.evaluate.stability.places import TrialScene
from splatnode.recon.evaluate.stability.stock import make_camera_estimate
from splatnode.recon.evaluate.stability.windows.ours import load_window_frames
from splatnode.recon.evaluate.stability.windows.row import WindowAnswer
from splatnode.recon.evaluate.stability.windows.store import Key, Pieces
from splatnode.recon.evaluate.stability.windows.window import Window
from splatnode.recon.evaluate.timing import Timing, measure_timing
from splatnode.recon.jobs.alone import now

MAPPERS: Mapping[str, colmap.Mapper] = {"colmap": colmap.map_incrementally, "glomap": colmap.map_globally}
_KIND = "colmap"  # of pieces: those of both mappers


def answer_window(
    place: TrialScene, window: Window, method: str, seed: int, fresh: bool, known: Pieces
) -> tuple[WindowAnswer, dict[Key, bytes]]:
    """The answer, and what was found for it that is not `known` of the scene. It is called in a process of its own.

    `fresh`: measures the seconds from photographs on, too.
    """
    frames, mapper = load_window_frames(place, window), MAPPERS[method]
    with TemporaryDirectory(prefix="splatnode-window-") as name:
        folder = Path(name)
        named = colmap.name_images(frames)
        found = _match_images(folder, named, seed, known)
        since, started = now(), time.perf_counter()
        model = colmap.map_largest_model(folder, named, seed, mapper)
        seconds, timed_on = time.perf_counter() - started, measure_timing(since)
    fresh_seconds, fresh_on = _time_fresh_run(frames, seed, mapper) if fresh else (None, None)
    registered = () if model is None else model.registered
    said = make_verdict(frames, {each.frame.name for each in registered})
    cameras = tuple(map(make_camera_estimate, registered))
    return WindowAnswer(said, cameras, seconds, timed_on, fresh_seconds, fresh_on), found


def _match_images(folder: Path, named: Mapping[str, Frame], seed: int, known: Pieces) -> dict[Key, bytes]:
    """Makes the database of the images, which are `named`, in `folder`; returns what was found that is not known."""
    keys = {image: (_KIND, frame.name) for image, frame in named.items()}
    described = {image: pickle.loads(known[key]) for image, key in keys.items() if key in known}
    of_pair = {pair: (_KIND, *(named[image].name for image in pair)) for pair in itertools.combinations(named, 2)}
    matches = {pair: pickle.loads(known[key]) for pair, key in of_pair.items() if key in known}
    colmap.extract_features(folder, named, seed, described)
    colmap.match_pairs(folder, list(of_pair), seed, matches)
    found = {keys[image]: each for image, each in colmap.read_features(folder, set(named) - set(described)).items()}
    found |= {of_pair[pair]: each for pair, each in colmap.read_matches(folder, set(of_pair) - set(matches)).items()}
    return {key: pickle.dumps(piece) for key, piece in found.items()}


def _time_fresh_run(frames: Sequence[Frame], seed: int, mapper: colmap.Mapper) -> tuple[float, Timing]:
    since, started = now(), time.perf_counter()
    colmap.reconstruct_sparse_model(frames, seed, mapper)
    return time.perf_counter() - started, measure_timing(since)
