"""splatnode's answers to windows: the steps of recon/pipeline.py up to the verdict."""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction, estimate_cameras
from splatnode.recon.evaluate.stability.own_cameras import ensure_registration, list_registered_cameras
from splatnode.recon.evaluate.stability.places import TrialScene
from splatnode.recon.evaluate.stability.windows.row import WindowAnswer
from splatnode.recon.evaluate.stability.windows.store import Key, Pieces, load_plain_features, match_keyframes
from splatnode.recon.evaluate.stability.windows.window import Window
from splatnode.recon.evaluate.timing import Timing, measure_timing
from splatnode.recon.frames.screening import screen_all
from splatnode.recon.jobs.alone import now
from splatnode.recon.ladder.ladder import run_fallbacks
from splatnode.recon.matching.match import match
from splatnode.recon.matching.moving import mask_moving_objects
from splatnode.recon.preparation import load_prior, prepare

Told = Literal["nothing", "exif", "given"]  # of the lens
EXIF_ERROR = 0.03  # by which EXIF's focal length is off at most, of its logarithm


def answer_window(
    place: TrialScene, window: Window, config: ReconstructionConfig, fresh: bool, told: Told, known: Pieces
) -> tuple[WindowAnswer, dict[Key, bytes]]:
    """The answer, and what was found for it that is not `known` of the scene. It is called in a process of its own.

    `told`: what comes with the photographs, see `load_window_frames`; `fresh`: measures the seconds from photographs on, too.
    """
    matcher, frames = load_prior(config).matcher, load_window_frames(place, window, told)
    kept, _, rejected = screen_all(frames, config.screening)
    keyframes = [prepare(frame, config, load_plain_features(known, frame.name)) for frame in kept]
    graph, found = match_keyframes(keyframes, known, config.matching, matcher)
    graph = mask_moving_objects(graph, matcher)
    since, started = now(), time.perf_counter()
    estimate = run_fallbacks(estimate_cameras(graph, rejected, config), rejected, config)
    seconds, timed_on = time.perf_counter() - started, measure_timing(since)
    fresh_seconds, fresh_on = _time_fresh_run(frames, config) if fresh else (None, None)
    estimate = ensure_registration(estimate, config)
    cameras, evidence = list_registered_cameras(estimate), estimate.evidence_record
    return WindowAnswer(estimate.verdict, cameras, seconds, timed_on, fresh_seconds, fresh_on, evidence), found


def load_window_frames(place: TrialScene, window: Window, told: Told = "nothing") -> list[Frame]:
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


def estimate_without_store(frames: Sequence[Frame], config: ReconstructionConfig) -> Reconstruction:
    """Cameras and verdict of the frames, with nothing kept of other windows."""
    kept, _, rejected = screen_all(frames, config.screening)
    matcher = load_prior(config).matcher
    graph = mask_moving_objects(match([prepare(frame, config) for frame in kept], config.matching, matcher), matcher)
    return run_fallbacks(estimate_cameras(graph, rejected, config), rejected, config)


def _time_fresh_run(frames: Sequence[Frame], config: ReconstructionConfig) -> tuple[float, Timing]:
    since, started = now(), time.perf_counter()
    estimate_without_store(frames, config)
    return time.perf_counter() - started, measure_timing(since)
