"""Photographs that follow another one: part of `python -m tests.bench locate`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.recon.config import preset
from splatnode.recon.estimation import estimate_cameras, prepare
from splatnode.recon.geometry import align_cameras, angles_deg
from splatnode.recon.locating import LocalizationBounds, Located, NotLocated
from splatnode.recon.locating.localize import (
    QUICK,
    Localization,
    QueryImage,
    localize_image,
    localize_near,
    prepare_query_image,
)
from splatnode.recon.matching.view_graph import match
from splatnode.recon.result.snapshot import Landmarks

Array = npt.NDArray[np.float64]

SIDE = 800  # pixels, of the photographs that seconds and cover are of
NEAR_STRANGERS = 3  # cameras of a scene near to which another scene's photographs are looked for
FAR_PERCENT = 2.0  # of the distance: who lies farther from where looking everywhere places it is wrong


@dataclass(frozen=True)
class FollowingFrame:
    """A frame of a video of the built-in capture, by the one before it."""

    place: int
    frame: int
    quickly: bool
    seconds: float
    rotation_deg: float | None
    centre_percent: float | None


def errors_of(found: Located | NotLocated, truth: Array, unit: float) -> dict[str, float]:
    if isinstance(found, NotLocated):
        return {}
    T = found.T_world_camera
    return {
        "points": found.num_points,
        "rotation_deg": float(angles_deg(T[None, :3, :3], truth[None, :3, :3])[0]),
        "centre_percent": 100.0 * float(np.linalg.norm(T[:3, 3] - truth[:3, 3])) / unit,
        "rotation_claim_deg": found.claim.rotation_deg,
        "centre_claim_percent": found.claim.centre_percent,
    }


def nearby(landmarks: Landmarks, image: npt.NDArray[np.uint8], first: Located, before: Array) -> dict[str, object]:
    """What is found near to `before` and near to the farthest camera, where it is not looked for everywhere."""
    photograph, Ts = prepare_query_image(image, None, QUICK), landmarks.Ts_world_camera
    centre = first.T_world_camera[:3, 3]
    farthest = Ts[np.argmax(np.linalg.norm(Ts[:, :3, 3] - centre, axis=1))]
    near, far = (localize_near(landmarks, photograph, replace(first, T_world_camera=T)) for T in (before, farthest))
    outcome = "refused"
    if isinstance(far, Localization):
        apart = np.linalg.norm(far.located.T_world_camera[:3, 3] - centre) / landmarks.unit
        outcome = "right" if 100.0 * apart <= FAR_PERCENT else "wrong"
    return {"quickly": isinstance(near, Localization), "near_farthest": outcome}


def placed_near(landmarks: Landmarks, photograph: QueryImage) -> bool:
    """Whether a photograph is placed near to one of the scene's first cameras, as if theirs had taken it."""
    frame = photograph.frame
    for T, focal in list(zip(landmarks.Ts_world_camera, landmarks.lenses.focals, strict=True))[:NEAR_STRANGERS]:
        K = np.diag([focal * max(frame.width, frame.height)] * 2 + [1.0])
        K[:2, 2] = frame.width / 2, frame.height / 2
        before = Located(T, K, np.zeros((6, 6)), LocalizationBounds(0.0, 0.0, 0.0, 5.0), 0, False)
        if isinstance(localize_near(landmarks, photograph, before), Localization):
            return True
    return False


def video(place: int) -> Iterator[FollowingFrame]:
    """The first frame is placed by itself, each further one by the one before; there are 8 a photograph's step."""
    config = synthetic.Config(views=6, width=SIDE, height=600, seed=place)
    frames, names = list(synthetic.stream(config)), [synthetic.frame_name(index) for index in range(config.views)]
    graph = match([prepare(frame, preset("balanced")) for frame in frames], preset("balanced").matching, None)
    landmarks = estimate_cameras(graph, (), preset("balanced")).landmarks
    assert landmarks is not None and len(landmarks.names) == len(names)
    true = np.stack([T for T, _ in synthetic.scene_cameras(config)])
    to_scene, last = align_cameras(true, landmarks.Ts_world_camera), None
    for number, camera in enumerate(synthetic.video_cameras(config, 8)[10:30]):
        image = synthetic.render_image(config, camera, 1000 + number)
        begun, quick = time.process_time(), None
        if isinstance(last, Located):
            quick = localize_near(landmarks, prepare_query_image(image, None, QUICK), last)
        found = quick.located if isinstance(quick, Localization) else localize_image(landmarks, image)
        seconds = time.process_time() - begun
        errors = errors_of(found, to_scene.camera(camera[0]), landmarks.unit)
        if number:
            error = errors.get("rotation_deg"), errors.get("centre_percent")
            yield FollowingFrame(place, number, isinstance(quick, Localization), seconds, *error)
        last = found


def of_frames(frames: Sequence[FollowingFrame]) -> dict[str, object]:
    """What the page prints of videos."""
    return {
        "frames": len(frames),
        "frames_quickly": sum(frame.quickly for frame in frames),
        "frames_seconds_median": float(np.median([frame.seconds for frame in frames])) if frames else None,
        "frames_seconds_most": max((frame.seconds for frame in frames), default=None),
        "frames_largest_error": [
            max((getattr(frame, name) or 0.0 for frame in frames), default=None)
            for name in ("rotation_deg", "centre_percent")
        ],
    }
