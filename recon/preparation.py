"""What is needed before frames can be matched: the loaded prior, and each frame as a keyframe."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace

import msgspec

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.lenses import undistort_frame
from splatnode.capture.process.system import raise_shortage
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.keyframes import LIBRARY_ERRORS, Features, Keyframe, resize_image
from splatnode.recon.matching import features
from splatnode.recon.priors.prior import Prior
from splatnode.recon.rasterize.dispatch import choose_device, format_device

log = logging.getLogger(__name__)


class UnusableFrame(ValueError):
    """One frame that cannot become a keyframe; the text names it and says why."""


def load_prior(config: ReconstructionConfig) -> Prior:
    """The prior that the configuration names. Raises ValueError or FileNotFoundError where it lacks its weights."""
    return config.prior.module.load(msgspec.structs.replace(config.prior.config, seed=config.seed))


def check_device(config: ReconstructionConfig) -> None:
    """Before the work begins: raises DeviceUnavailable; the log tells the device where it was left open."""
    device = choose_device(config.device)
    if config.device != "cpu":
        log.info("%s", format_device(config.device, device))


def prepare(frame: Frame, config: ReconstructionConfig, found: Features | None = None) -> Keyframe:
    """The frame without distortion, with its image at modelled size and its features, unless these are known.

    No other frame is needed. Raises UnusableFrame where the given intrinsics cannot be used, or a library fails.
    """
    try:
        straight = undistort_frame(frame)
    except ValueError as error:  # it names the frame
        raise UnusableFrame(str(error)) from error
    except LIBRARY_ERRORS as error:
        raise_shortage(error)
        raise UnusableFrame(f"{frame.name}: its distortion cannot be taken out: {error}") from error
    frame = replace(straight, encoded=None)  # recordings alone want the file as it came
    try:
        found = found or features.apply_mask(features.extract(frame.image, config.matching.features), frame.mask)
        return Keyframe(frame, resize_image(frame.image, config.size), found)
    except LIBRARY_ERRORS as error:
        raise_shortage(error)
        raise UnusableFrame(f"{frame.name}: no features can be found in it: {error}") from error


def prepare_all(frames: Iterable[Frame], config: ReconstructionConfig) -> tuple[list[Keyframe], list[DroppedFrame]]:
    """The keyframes of all frames that can become one, and the others with the reason, which the log tells too.

    Raises UnusableFrame, of the first frame, where none of them can: then what they have in common is to blame.
    """
    keyframes, dropped, first = list[Keyframe](), list[DroppedFrame](), None
    for frame in frames:
        try:
            keyframes.append(prepare(frame, config))
        except UnusableFrame as error:
            log.warning("left out: %s", error)
            dropped.append(DroppedFrame(frame.name, str(error).removeprefix(f"{frame.name}: ")))
            first = first or error
    if first is not None and not keyframes:
        raise first
    return keyframes, dropped
