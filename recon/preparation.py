"""What is needed before frames can be matched: the loaded prior, and each frame as a keyframe."""

from __future__ import annotations

import logging
from dataclasses import replace

import msgspec

from splatnode.capture.frame import Frame
from splatnode.capture.lenses.undistort import undistorted
from splatnode.recon.config import Config
from splatnode.recon.frames.keyframe import Features, Keyframe, modelled_image
from splatnode.recon.matching import features
from splatnode.recon.priors.prior import Prior
from splatnode.recon.rasterize.device import chosen, in_words

log = logging.getLogger(__name__)


def load_prior(config: Config) -> Prior:
    """The prior that the configuration names. Raises ValueError or FileNotFoundError where it lacks its weights."""
    return config.prior.module.load(msgspec.structs.replace(config.prior.config, seed=config.seed))


def check_device(config: Config) -> None:
    """Before the work begins: raises DeviceUnavailable; the log tells the device where it was left open."""
    device = chosen(config.device)
    if config.device != "cpu":
        log.info("%s", in_words(config.device, device))


def prepare(frame: Frame, config: Config, found: Features | None = None) -> Keyframe:
    """The frame without distortion, with its image at modelled size and its features, unless these are known.

    No other frame is needed. Raises ValueError where the given intrinsics cannot be used.
    """
    frame = replace(undistorted(frame), encoded=None)  # recordings alone want the file as it came
    found = found or features.used(features.extract(frame.image, config.matching.features), frame.mask)
    return Keyframe(frame, modelled_image(frame.image, config.size), found)
