"""One number tells where a Gaussian comes from."""

from __future__ import annotations

import numpy as np
import torch

from splatnode.recon.result.sources import SHELL, filled, frame_of, seen


def test_the_frame_and_whether_two_photographs_confirm_it_come_back():
    sources = np.array([0, 7, filled(0), filled(7), SHELL], np.int32)
    assert frame_of(sources).tolist() == [0, 7, 0, 7, SHELL]
    assert frame_of(torch.from_numpy(sources)).tolist() == [0, 7, 0, 7, SHELL]
    assert seen(sources).tolist() == [True, True, False, False, False]
    assert frame_of(sources).dtype == np.int32
    assert len(set(sources.tolist())) == 5
