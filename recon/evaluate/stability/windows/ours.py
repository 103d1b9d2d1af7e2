"""splatnode's answers to windows: the steps of recon/pipeline.py up to the verdict."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator, Sequence

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.recon.config import Config
from splatnode.recon.estimation import Estimate, estimate_cameras
from splatnode.recon.evaluate.stability.own_cameras import cameras_of, registered
from splatnode.recon.evaluate.stability.places import Place
from splatnode.recon.evaluate.stability.windows.row import Answer
from splatnode.recon.evaluate.stability.windows.store import matched
from splatnode.recon.evaluate.stability.windows.window import Window
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.frames.screening import screen_all
from splatnode.recon.ladder.ladder import climbed
from splatnode.recon.matching.match import match
from splatnode.recon.matching.moving import without_moving
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.preparation import load_prior, prepare


def answers(
    place: Place, windows: Sequence[Window], config: Config, fresh: bool, given_lens: bool = False
) -> Iterator[tuple[Window, Answer]]:
    """One answer a window, in their order; `given_lens`: the true intrinsics come with the photographs.

    An exception is an answer, too: the others are asked all the same.
    """
    prior = load_prior(config)
    known: dict[str, Keyframe] = {}
    store = ViewGraph(config.matching)
    for window in windows:
        frames = frames_of(place, window, given_lens)
        try:
            kept, _, rejected = screen_all(frames, config.screening)
            for frame in kept:
                known[frame.name] = known.get(frame.name) or prepare(frame, config)
            graph, store = matched(store, [known[frame.name] for frame in kept], prior.matcher)
            graph = without_moving(graph, prior.matcher)
            started = time.perf_counter()
            estimate = climbed(estimate_cameras(graph, rejected, config), rejected, config)
            seconds = time.perf_counter() - started
            fresh_seconds = _fresh_seconds(frames, config) if fresh else None
            answer = _answer(registered(estimate, config), seconds, fresh_seconds)
        except Exception:
            answer = Answer(None, message=traceback.format_exc())
        yield window, answer


def frames_of(place: Place, window: Window, given_lens: bool = False) -> list[Frame]:
    """The photographs; their ids are their positions in the scene.

    Nothing is known about the camera, or with `given_lens` its true intrinsics.
    """
    frames = []
    for name in window.names:
        index, image = place.names.index(name), place.scene.image(name)
        intrinsics = _true_intrinsics(place, name, image.shape[1], image.shape[0]) if given_lens else None
        frames.append(Frame(index, name, index, image, intrinsics))
    return frames


def _true_intrinsics(place: Place, name: str, width: int, height: int) -> Intrinsics:
    K = place.scene.cameras[name].K_for(width, height)
    return Intrinsics(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], "given")


def from_scratch(frames: Sequence[Frame], config: Config) -> Estimate:
    """Cameras and verdict of the frames, with nothing kept of other windows."""
    kept, _, rejected = screen_all(frames, config.screening)
    matcher = load_prior(config).matcher
    graph = without_moving(match([prepare(frame, config) for frame in kept], config.matching, matcher), matcher)
    return climbed(estimate_cameras(graph, rejected, config), rejected, config)


def _fresh_seconds(frames: Sequence[Frame], config: Config) -> float:
    started = time.perf_counter()
    from_scratch(frames, config)
    return time.perf_counter() - started


def _answer(estimate: Estimate, seconds: float, fresh_seconds: float | None) -> Answer:
    return Answer(estimate.verdict, cameras_of(estimate), seconds, fresh_seconds, estimate.evidence_record)
