"""Which rig a reconstruction is given, with its lenses: that of a file, or what a recording tells of its cameras."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from os import PathLike
from pathlib import Path

import msgspec
import numpy as np

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.lens_file import Lenses, describe_image
from splatnode.capture.multi_camera import CameraSet
from splatnode.capture.process.notices import notify
from splatnode.capture.process.terminal import Tell
from splatnode.capture.process.text import sanitize_text
from splatnode.capture.rig import MOUNT_SIGMA_DEG, MOUNT_SIGMA_M, Rig, RigCamera
from splatnode.capture.rig_file import read_rig
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.replay_source import ReplayRecording, Source

log = logging.getLogger(__name__)

DRAWN_SIGMA_M, DRAWN_SIGMA_DEG = MOUNT_SIGMA_M, MOUNT_SIGMA_DEG  # by a log's static transforms
LONGEST_BASELINE_M = 20.0  # between two cameras of a robot; beyond, the file is probably in millimetres
_TRUSTED = ("given", "calibration")  # sources of a lens that a rig's does not replace


def apply_rig(
    given: Source, config: ReconstructionConfig, file: str | PathLike[str] | None, tell: Tell
) -> tuple[Source, ReconstructionConfig]:
    """The frames with the lenses of their rig, and the configuration with it: that of a file, or of their recording.

    What of the rig does not count is notified. Raises as `choose_rig` and `add_rig_lenses`.
    """
    rig = choose_rig(None if file is None else Path(file), given.cameras, tell)
    if rig is None:
        return given, config
    given = add_mounts(given, rig)
    if len(rig.cameras) < 2:
        return given, config
    with_lenses = add_rig_lenses(given, rig)
    for text in describe_rig_use(rig, [each.camera_id for each in given.frames if isinstance(each, Frame)]):
        notify(log, text)
    return with_lenses, hold_rig(config, rig)


def choose_recording_rig(
    recording: ReplayRecording, config: ReconstructionConfig, file: str | PathLike[str] | None, tell: Tell
) -> tuple[Rig | None, ReconstructionConfig]:
    """As `apply_rig`, of a recording whose frames are not in memory: `place_on_rig` is for each of them."""
    rig = choose_rig(None if file is None else Path(file), recording.request.cameras, tell)
    if rig is None:
        return None, config
    ids = [camera_id for _, _, camera_id, *_ in recording.images]
    _check_mounts(rig, ids)
    if len(rig.cameras) < 2:
        return rig, config
    _check_names(rig, ids)
    lenses = _collect_lenses(rig, ids)
    lenses.check(recording.images)
    for text in describe_rig_use(rig, ids):
        notify(log, text)
    return rig, hold_rig(config, rig)


def place_on_rig(each: Frame | DroppedFrame, rig: Rig) -> Frame | DroppedFrame:
    """The frame with where its camera stands on the base, and with the rig's lens where its own is not trusted."""
    if not isinstance(each, Frame):
        return each
    mount = rig.find_mount(each.camera_id)
    placed = replace(each, T_base_camera=mount) if mount else each
    return (
        placed
        if len(rig.cameras) < 2 or not _lacks_lens(each)
        else _collect_lenses(rig, [each.camera_id]).apply(placed)
    )


def add_mounts(given: Source, rig: Rig) -> Source:
    """The frames with where their camera stands on the robot's base, as far as the rig tells it.

    Raises ValueError where it tells it of no camera of the frames.
    """
    _check_mounts(rig, [each.camera_id for each in given.frames if isinstance(each, Frame)])
    told = {each.name: rig.find_mount(each.camera_id) for each in given.frames if isinstance(each, Frame)}
    frames = (replace(each, T_base_camera=mount) if isinstance(each, Frame) and (mount := told[each.name]) else each
              for each in given.frames)  # fmt: skip
    return replace(given, frames=tuple(frames))


def _check_mounts(rig: Rig, camera_ids: Sequence[str]) -> None:
    if rig.is_base and camera_ids and not any(map(rig.find_mount, camera_ids)):
        names = ", ".join(each.camera_id for each in rig.cameras)
        raise ValueError(
            f"the rig has T_base_camera of {sanitize_text(names, 200)}, and no image is of such a camera. Name the "
            "cameras as the rig does: --cameras A,B"
        )


def describe_rig_use(rig: Rig, camera_ids: Iterable[str]) -> Iterator[str]:
    """Describes what of a rig does not count for images of these cameras, and what of it is probably not meant."""
    ids = list(camera_ids)
    there = set(ids) - {""}
    if not there:
        return
    used = [each for each in rig.cameras if each.camera_id in there]
    absent = [each.camera_id for each in rig.cameras if each.camera_id not in there]
    further = sorted(there - {each.camera_id for each in used})
    if absent:
        yield (
            f"no image is of {_join(absent)} of the rig, so the rig counts for {_join(e.camera_id for e in used)} "
            "alone. Name the cameras as the rig does (--cameras, camera_ids), or leave those out of it"
        )
    if further:
        yield (
            f"the rig does not have {_join(further)}, whose images are there: these images alone tell where it stands. "
            f"The rig has {_join(each.camera_id for each in rig.cameras)}; name the cameras as it does, or add it"
        )
    if unnamed := ids.count(""):
        yield f"{unnamed} of {len(ids)} images are of no camera that is named: the rig does not count for these"
    unplaced = [each.camera_id for each in used if each.matrix is None]
    if unplaced:
        few = len(used) - len(unplaced) < 2
        yield (
            f"the rig does not tell where {_join(unplaced)} stands (T_rig_camera, or cam_from_rig of COLMAP): the "
            "images alone tell it. "
            + ("The rig gives no metres: give two cameras or more a pose" if few else "The others give the metres")
        )
    yield from _describe_lengths(used)


def _describe_lengths(cameras: Iterable[RigCamera]) -> Iterator[str]:
    placed = [each for each in cameras if each.matrix is not None]
    centres = {each.camera_id: each.matrix[:3, 3] for each in placed if each.matrix is not None}
    apart = [(float(np.linalg.norm(centres[a] - centres[b])), a, b) for a, b in combinations(centres, 2)]
    longest = max(apart, default=None)
    if longest is not None and longest[0] > LONGEST_BASELINE_M:
        yield (
            f"the rig has {_join([longest[1]])} and {_join([longest[2]])} {longest[0]:.3g} m apart: its poses are "
            "metres. Where they are millimetres, divide the translations by 1000; else all lengths are 1000 times too "
            "large"
        )
    elif longest is not None and longest[0] <= max(each.sigma_m for each in placed):
        yield f"the rig has {_join(centres)} in one place, within their sigma_m: it gives no metres"


def _join(camera_ids: Iterable[str]) -> str:
    return sanitize_text(", ".join(camera_ids), 200)


def choose_rig(file: Path | None, cameras: CameraSet | None, tell: Tell) -> Rig | None:
    """The rig of a file, else that of the static transforms of the one log of all cameras; None: neither tells one.

    Raises UnusableRig where the file gives none. `tell` hears what the log tells, or why it tells nothing.
    """
    if file is not None:
        return read_rig(file)
    try:
        told = None if cameras is None else cameras.find_rig()
    except ValueError as error:
        tell(f"no rig is known before, the images tell: {error}")
        return None
    if told is None:
        return None
    tell(
        f"the static transforms of the recording tell where its {len(told.cameras)} cameras stand, "
        f"within {100 * DRAWN_SIGMA_M:g} cm and {DRAWN_SIGMA_DEG:g} degrees (--rig FILE in place of these)"
    )
    return Rig(tuple(replace(each, sigma_m=DRAWN_SIGMA_M, sigma_deg=DRAWN_SIGMA_DEG) for each in told.cameras))


def hold_rig(config: ReconstructionConfig, rig: Rig) -> ReconstructionConfig:
    """The configuration with a rig that is given."""
    return msgspec.structs.replace(config, registration=msgspec.structs.replace(config.registration, rig=rig))


def add_rig_lenses(given: Source, rig: Rig) -> Source:
    """The frames, each whose lens is neither given nor calibrated with the lens that the rig has of its camera.

    Raises ValueError where fewer than two of the rig's cameras took frames, or a lens is of none of their aspect ratio.
    """
    frames = [each for each in given.frames if isinstance(each, Frame)]
    _check_names(rig, [each.camera_id for each in frames])
    lensless = [each for each in frames if _lacks_lens(each)]
    lenses = _collect_lenses(rig, [each.camera_id for each in lensless])
    lenses.check(map(describe_image, lensless))
    added = {each.name: lenses.apply(each) for each in lensless}
    return replace(given, frames=tuple(added.get(each.name, each) for each in given.frames))


def _lacks_lens(frame: Frame) -> bool:
    return frame.intrinsics is None or frame.intrinsics.source not in _TRUSTED


def _collect_lenses(rig: Rig, camera_ids: Collection[str]) -> Lenses:
    """The lenses that the rig has of these cameras."""
    return Lenses({each.camera_id: each.intrinsics for each in rig.cameras
                   if each.intrinsics is not None and each.camera_id in camera_ids})  # fmt: skip


def _check_names(rig: Rig, camera_ids: Collection[str]) -> None:
    there = set(camera_ids) - {""}
    if camera_ids and sum(camera.camera_id in there for camera in rig.cameras) < 2:
        raise ValueError(
            f"a rig must name two or more of the cameras of the images; it has "
            f"{_join(each.camera_id for each in rig.cameras)}, and the "
            f"images are of {_join(sorted(there)) or 'no cameras that are named'}. Name the "
            "cameras as the rig does: --cameras A,B with a folder or a film of each in their order"
        )
