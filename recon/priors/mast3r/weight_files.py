"""Reads a MASt3R checkpoint: the official file, a dict with `model` and an `args` namespace, or a safetensors file."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from splatnode.recon.networks import weight_files
from splatnode.recon.priors.mast3r.network import PUBLISHED, Mast3r, Size

LICENCE = (
    "MASt3R's weights are licensed CC BY-NC-SA 4.0 (with the terms of its training sets, mapfree among them): "
    "for non-commercial use only."
)


def load_network(path: Path, size: Size = PUBLISHED) -> Mast3r:
    """The network with the weights of `path`, ready for inference in float32.

    Raises ValueError where the file is damaged, holds another model or anything but data, and FileNotFoundError.
    """
    return weight_files.load_network(partial(Mast3r, size), weight_files.read_weights(path), path, "MASt3R")
