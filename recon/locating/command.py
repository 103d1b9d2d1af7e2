"""The verb locate: where further photographs were taken, in a result that was saved."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.lenses import read_lens, same_aspect
from splatnode.capture.process.terminal import say
from splatnode.recon.locating.localize import (
    check_lens,
    choose_intrinsics,
    localize_query,
    prepare_query_image,
    stream_query_frames,
)
from splatnode.recon.locating.outcome import Located, NotLocated
from splatnode.recon.result.export.staged import json_bytes, write_file
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.npz_files import read_landmarks
from splatnode.recon.result.snapshot import Landmarks

EXIT_GOOD, EXIT_REFUSED = 0, 65


def locate(args: argparse.Namespace) -> int:
    """A line a photograph; EXIT_GOOD where all were placed."""
    landmarks = read_landmarks(args.result)
    given = None if args.intrinsics is None else read_lens(args.intrinsics)
    if given is not None:
        check_lens(given, stream_query_frames(args.images, None))
    records, refused, of_other_lens = [], 0, 0
    for frame in stream_query_frames(args.images, given):
        found = frame if isinstance(frame, DroppedFrame) else _localize_frame(landmarks, frame, args.fov)
        say(f"{frame.name}: {f'left out: {found.reason}' if isinstance(found, DroppedFrame) else found.sentence}")
        records.append({"name": frame.name, **_record(found, frame)})
        refused += not isinstance(found, Located)
        if given is not None and isinstance(frame, Frame):
            of_other_lens += not same_aspect(given, frame.width, frame.height)
    if of_other_lens:
        say(f"the lens was not given to {of_other_lens} of them, which have another aspect ratio than its images")
    say(f"{len(records) - refused} of {len(records)} photographs were placed in {args.result}")
    if args.json is not None:
        world = replace(StoredResult.create_from_path(args.result).scale(), metric=landmarks.metric)
        told = {"result": str(args.result), "unit": world.unit, "scale": world.word, "frame": None}  # nobody tells it
        told |= world.frame.record() if (args.result / "cameras.json").is_file() else {}
        write_file(args.json, json_bytes({**told, "photographs": records}))
        say(f"results: {args.json}")
    return EXIT_REFUSED if refused else EXIT_GOOD


def _localize_frame(landmarks: Landmarks, frame: Frame, fov_deg: float | None) -> Located | NotLocated | DroppedFrame:
    """Localizes a frame; drops one whose lens cannot be undistorted, which costs no other image."""
    try:
        photograph = prepare_query_image(frame.image, choose_intrinsics(frame, fov_deg), name=frame.name)
    except ValueError as error:
        return DroppedFrame(frame.name, str(error).removeprefix(f"{frame.name}: "))
    return localize_query(landmarks, photograph)


def _record(found: Located | NotLocated | DroppedFrame, frame: Frame | DroppedFrame) -> dict[str, object]:
    if isinstance(found, DroppedFrame):
        return {"placed": False, "code": "UNREADABLE", "message": found.reason}
    if isinstance(found, NotLocated):
        return {"placed": False, "code": found.code.value, "message": found.message, "advice": found.advice}
    assert isinstance(frame, Frame)  # it was located
    arrays = {name: getattr(found, name).tolist() for name in ("T_world_camera", "K", "covariance")}
    size = {"width": frame.width, "height": frame.height}
    lens = {"lens": found.lens.value, "distortion": list(found.distortion)}
    return {"placed": True, **arrays, **size, **lens, "claim": asdict(found.claim), "points": found.num_points}
