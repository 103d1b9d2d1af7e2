"""What is needed before frames can be matched: the loaded prior, and each frame as a keyframe."""

from __future__ import annotations

import logging

import msgspec
import torch

from splatnode.capture.frame import Frame
from splatnode.recon.config import Config
from splatnode.recon.frames.keyframe import Features, Keyframe, modelled_image
from splatnode.recon.frames.undistort import undistorted
from splatnode.recon.matching import features
from splatnode.recon.priors.prior import Prior
from splatnode.recon.rasterize.device import chosen, in_words

log = logging.getLogger(__name__)


def load_prior(config: Config) -> Prior:
    """The prior that the configuration names. Raises ValueError or FileNotFoundError where it lacks its weights."""
    return config.prior.module.load(msgspec.structs.replace(config.prior.config, seed=config.seed))


def load_device(config: Config) -> torch.device:
    """The device that scenes will be refined on, which the log tells where it was left open.

    Raises DeviceUnavailable: before the work begins, that is.
    """
    device = chosen(config.device)
    if config.device != "cpu":
        log.info("%s", in_words(config.device, device))
    return device


def prepare(frame: Frame, config: Config, found: Features | None = None) -> Keyframe:
    """The frame without distortion, with its image at modelled size and its features, unless these are known.

    No other frame is needed. Raises ValueError where the given intrinsics cannot be used.
    """
    frame = undistorted(frame)
    found = found or features.extract(frame.image, config.matching.features)
    return Keyframe(frame, modelled_image(frame.image, config.size), found)
