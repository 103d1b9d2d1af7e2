"""splatnode's answers to windows: the steps of recon/pipeline.py up to the verdict."""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.recon.config import Config
from splatnode.recon.estimation import Estimate, estimate_cameras
from splatnode.recon.evaluate.stability.own_cameras import cameras_of, registered
from splatnode.recon.evaluate.stability.places import Place
from splatnode.recon.evaluate.stability.windows.row import Answer
from splatnode.recon.evaluate.stability.windows.store import Key, Pieces, matched, plain_features
from splatnode.recon.evaluate.stability.windows.window import Window
from splatnode.recon.evaluate.timing import Timing, timing
from splatnode.recon.frames.screening import screen_all
from splatnode.recon.jobs.alone import now
from splatnode.recon.ladder.ladder import climbed
from splatnode.recon.matching.match import match
from splatnode.recon.matching.moving import without_moving
from splatnode.recon.preparation import load_prior, prepare

Told = Literal["nothing", "exif", "given"]  # of the lens
EXIF_ERROR = 0.03  # by which EXIF's focal length is off at most, of its logarithm


def answered(
    place: Place, window: Window, config: Config, fresh: bool, told: Told, known: Pieces
) -> tuple[Answer, dict[Key, bytes]]:
    """The answer, and what was found for it that is not `known` of the scene. It is called in a process of its own.

    `told`: what comes with the photographs, see `frames_of`; `fresh`: measures the seconds from photographs on, too.
    """
    matcher, frames = load_prior(config).matcher, frames_of(place, window, told)
    kept, _, rejected = screen_all(frames, config.screening)
    keyframes = [prepare(frame, config, plain_features(known, frame.name)) for frame in kept]
    graph, found = matched(keyframes, known, config.matching, matcher)
    graph = without_moving(graph, matcher)
    since, started = now(), time.perf_counter()
    estimate = climbed(estimate_cameras(graph, rejected, config), rejected, config)
    seconds, timed_on = time.perf_counter() - started, timing(since)
    fresh_seconds, fresh_on = _fresh_seconds(frames, config) if fresh else (None, None)
    estimate = registered(estimate, config)
    cameras, evidence = cameras_of(estimate), estimate.evidence_record
    return Answer(estimate.verdict, cameras, seconds, timed_on, fresh_seconds, fresh_on, evidence), found


def frames_of(place: Place, window: Window, told: Told = "nothing") -> list[Frame]:
    """The photographs without what masks hide; their ids are their positions in the scene.

    Nothing is known about the camera; or the true intrinsics are given; or EXIF tells the focal length alone, within
    3 %, by one factor for all photographs, as one camera errs.
    """
    frames = []
    generator = np.random.default_rng([window.start, window.stride, window.count, zlib.crc32(place.name.encode())])
    factor = float(np.exp(generator.uniform(-EXIF_ERROR, EXIF_ERROR)))
    for frame in place.scene.frames(window.names):
        index, intrinsics = place.names.index(frame.name), None
        if told != "nothing":
            intrinsics = place.scene.cameras[frame.name].intrinsics_for(frame.width, frame.height)
        if told == "exif" and intrinsics is not None:
            size, focal = (frame.width, frame.height), factor * intrinsics.fx
            intrinsics = Intrinsics(*size, focal, focal, size[0] / 2, size[1] / 2, "exif")
        frames.append(replace(frame, frame_id=index, stamp_ns=index, intrinsics=intrinsics))
    return frames


def from_scratch(frames: Sequence[Frame], config: Config) -> Estimate:
    """Cameras and verdict of the frames, with nothing kept of other windows."""
    kept, _, rejected = screen_all(frames, config.screening)
    matcher = load_prior(config).matcher
    graph = without_moving(match([prepare(frame, config) for frame in kept], config.matching, matcher), matcher)
    return climbed(estimate_cameras(graph, rejected, config), rejected, config)


def _fresh_seconds(frames: Sequence[Frame], config: Config) -> tuple[float, Timing]:
    since, started = now(), time.perf_counter()
    from_scratch(frames, config)
    return time.perf_counter() - started, timing(since)
