"""Gaussians as .splat: what is written reads back, the most visible first; foreign files are told."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.result.export import SceneFileError
from splatnode.recon.result.export.formats.splat import decode as decode_splat
from splatnode.recon.result.export.formats.splat import encode_splat
from splatnode.recon.result.export.limits import SH_C0
from tests.support.exported import make_gaussians, same_rotations


def test_splat_round_trip_puts_the_most_visible_first():
    gaussians = make_gaussians(num_bases=1)
    data = encode_splat(gaussians)
    assert len(data) == 32 * len(gaussians)
    visible = gaussians.opacities.astype(np.float64) * gaussians.scales.astype(np.float64).prod(1)
    order = np.argsort(-visible)
    back = decode_splat(data)
    assert np.array_equal(back.means, gaussians.means[order])
    assert np.array_equal(back.scales, gaussians.scales[order])
    assert np.allclose(back.opacities, gaussians.opacities[order], atol=0.5 / 255 + 1e-6)
    assert same_rotations(back.quats, gaussians.quats[order], degrees=1.0)
    assert np.allclose(back.sh[:, 0], gaussians.sh[order, 0], atol=0.5 / 255 / SH_C0 + 1e-6)


@pytest.mark.parametrize("data", [b"", b"\0" * 31, b"\xff" * 64, b"ply\n" * 8])
def test_foreign_splat_is_a_clear_error(data):
    with pytest.raises(SceneFileError, match="not a .splat file"):
        decode_splat(data)
