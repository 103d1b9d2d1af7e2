"""Which of the finished scenes look like a new one? By the codes of their images; that is verified afterwards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.messaging.wire import Message
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching.image_code import compute_global_descriptor

Codes = npt.NDArray[np.float16]  # (N, C) of N images, each of unit length

BEST = 3  # of the pairs of images by which two scenes are compared
_MIN_NORM = 1e-9


class DescriptorsRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """In a checkpoint. The only array holds the codes, a row each."""

    names: list[str]  # of the keyframes


def compute_global_descriptors(keyframes: Sequence[Keyframe]) -> Codes:
    return np.stack([compute_global_descriptor(keyframe.features) for keyframe in keyframes]).astype(np.float16)


def make_descriptors_message(
    keyframes: Sequence[Keyframe], codes: Codes
) -> tuple[DescriptorsRecord, list[npt.NDArray]]:
    return DescriptorsRecord([keyframe.name for keyframe in keyframes]), [codes.view(np.uint16)]


def parse_descriptors(message: Message[DescriptorsRecord]) -> Codes:
    """Parses the message of `make_descriptors_message`. Raises ValueError where another version wrote it."""
    if len(message.arrays) != 1 or len(message.arrays[0]) != len(message.header.names):
        raise ValueError("codes of another version")
    return np.array(message.arrays[0]).view(np.float16)


def compute_mean_descriptor(codes: Mapping[str, Codes]) -> npt.NDArray[np.float32]:
    """(C,) what the images of all scenes have in common: it tells none from another."""
    total = sum(each.sum(0, dtype=np.float32) for each in codes.values())
    return np.asarray(total / max(1, sum(map(len, codes.values()))), np.float32)


def centre_descriptors(codes: Codes, common: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """(N, C) without what all have in common, of unit length again: their products are cosines."""
    rest = codes.astype(np.float32) - common
    return rest / np.maximum(np.linalg.norm(rest, axis=1, keepdims=True), _MIN_NORM)


def rank_similar_scenes(scene: str, codes: Mapping[str, Codes]) -> list[str]:
    """The other scenes, that which looks most like `scene` first: by their BEST pairs of images."""
    common = compute_mean_descriptor(codes)
    mine = centre_descriptors(codes[scene], common)
    likeness = {}
    for other, theirs in codes.items():
        if other != scene:
            alike = (mine @ centre_descriptors(theirs, common).T).max(1)
            likeness[other] = float(np.sort(alike)[-BEST:].mean())
    return sorted(likeness, key=lambda other: (-likeness[other], other))
