"""Photographs of the built-in capture, as a program has them, and what comes of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import splatnode
from splatnode.capture.cameras import synthetic
from splatnode.capture.image_file import encode_png
from tests.support.synthetic import photographs

SMALL = synthetic.Config(views=4, width=320, height=240)
QUICK = {"optimize": {"iterations": 40}}


@pytest.fixture(scope="session")
def arrays() -> list[np.ndarray]:
    return [frame.image for frame in photographs(SMALL)]


@pytest.fixture(scope="session")
def folder(arrays, tmp_path_factory) -> Path:
    found = tmp_path_factory.mktemp("photographs")
    for index, image in enumerate(arrays):
        (found / f"{index:04d}.png").write_bytes(encode_png(image))
    return found


@pytest.fixture(scope="session")
def result(arrays) -> splatnode.Result:
    """Of the arrays."""
    found = splatnode.reconstruct(arrays, config=QUICK)
    assert found.verdict.publishable
    return found
