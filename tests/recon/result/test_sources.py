"""One number tells where a Gaussian comes from."""

from __future__ import annotations

import numpy as np
import torch

from splatnode.recon.result.snapshot import SHELL, decode_frame_id, encode_unconfirmed, find_confirmed


def test_the_frame_and_whether_two_photographs_confirm_it_come_back():
    sources = np.array([0, 7, encode_unconfirmed(0), encode_unconfirmed(7), SHELL], np.int32)
    assert decode_frame_id(sources).tolist() == [0, 7, 0, 7, SHELL]
    assert decode_frame_id(torch.from_numpy(sources)).tolist() == [0, 7, 0, 7, SHELL]
    assert find_confirmed(sources).tolist() == [True, True, False, False, False]
    assert decode_frame_id(sources).dtype == np.int32
    assert len(set(sources.tolist())) == 5
