"""A code of a whole image, made of its features: images of one place have similar codes.

The code is VLAD (Jegou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010) without
a learned codebook: its words are fixed random directions. Each word's sum of descriptors has unit length ("All about
VLAD", Arandjelovic and Zisserman, CVPR 2013), and what all descriptors have in common is taken out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import PLAIN, Features
from splatnode.recon.matching.nearest_neighbours import DESCRIPTOR_SIZE, QUANTISED_NORM

Code = npt.NDArray[np.float32]

_WORDS = 64
_MIN_NORM = 1e-9


def compute_global_descriptor(features: Features) -> Code:
    """(64 * 128,) the code of the plain features, of unit length; zeros where there are none."""
    descriptors = features.select_tilt(PLAIN).descriptors.astype(np.float32) / QUANTISED_NORM
    code = np.zeros((_WORDS, DESCRIPTOR_SIZE), np.float32)
    if not len(descriptors):
        return code.ravel()
    descriptors -= descriptors.mean(0)
    directions = np.random.default_rng(0).normal(size=(DESCRIPTOR_SIZE, _WORDS)).astype(np.float32)
    word = (descriptors @ (directions / np.linalg.norm(directions, axis=0))).argmax(1)
    order = np.argsort(word, kind="stable")
    words, first = np.unique(word[order], return_index=True)
    code[words] = np.add.reduceat(descriptors[order], first, axis=0)
    code /= np.maximum(np.linalg.norm(code, axis=1, keepdims=True), _MIN_NORM)
    return code.ravel() / np.sqrt(np.float32(len(words)))


def similarities(codes: Sequence[Code]) -> npt.NDArray[np.float32]:
    """(N, N) cosines of the codes, once what all of them have in common is taken out."""
    centred = np.stack(codes) - np.mean(codes, axis=0)
    centred /= np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), _MIN_NORM)
    return centred @ centred.T
