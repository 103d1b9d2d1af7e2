"""What needs a GPU, and the same comparisons with gsplat's own PyTorch in its place: so that they are known to run."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest
import torch

from splatnode.recon.rasterize import gsplat
from tests.gpu.agreement import figures, whole_figures
from tests.support import gsplat_by_torch

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


@contextlib.contextmanager
def by_torch() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        gsplat_by_torch.install(patch)
        yield


def test_gsplats_own_pytorch_agrees_with_the_core():
    for figure in figures(torch.device("cpu"), iterations=6, computing=by_torch):
        assert figure.kept, figure


@needs_gpu
def test_a_gpu_agrees_with_the_processor():
    if (obstacle := gsplat.find_unavailable_reason()) is not None:
        pytest.skip(f"needs the extra cuda: {obstacle}")
    for figure in figures(torch.device("cuda")):
        assert figure.kept, figure


@needs_gpu
def test_a_reconstruction_on_a_gpu_is_as_good(tmp_path):
    if (obstacle := gsplat.find_unavailable_reason()) is not None:
        pytest.skip(f"needs the extra cuda: {obstacle}")
    for figure in whole_figures("cuda", tmp_path)[0]:
        assert figure.kept, figure
