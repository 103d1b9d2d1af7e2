"""Gaussians that viewers could not take are left out or clamped, and a sane scene is not touched."""

from __future__ import annotations

import warnings

import numpy as np

from splatnode.recon.result.export.formats.ply import decode as decode_ply
from splatnode.recon.result.export.formats.ply import encode_ply
from splatnode.recon.result.export.formats.splat import decode as decode_splat
from splatnode.recon.result.export.formats.splat import encode_splat
from splatnode.recon.result.export.formats.spz import decode as decode_spz
from splatnode.recon.result.export.formats.spz import encode_spz
from splatnode.recon.result.export.limits import sanitize_gaussians
from tests.support.exported import make_gaussians


def test_viewer_safe_leaves_out_and_clamps_what_would_break_a_viewer():
    gaussians = make_gaussians(100)
    gaussians.means[0] = np.nan
    gaussians.means[1] = 1e9
    gaussians.sh[2, 3, 1] = np.inf
    gaussians.scales[3] = [0.0, 1e12, 0.1]
    gaussians.opacities[4:6] = [0.0, 1.0]
    gaussians.quats[6] = 0.0
    gaussians.quats[7] *= 20.0
    safe = sanitize_gaussians(gaussians)
    assert len(safe) == 97
    assert np.array_equal(safe.means, gaussians.means[3:])
    assert safe.scales[0].min() > 0 and safe.scales[0].max() < 100
    assert np.array_equal(safe.quats[3], [1, 0, 0, 0])
    assert np.allclose(np.linalg.norm(safe.quats, axis=1), 1.0, atol=1e-6)
    for encode, decode in [(encode_ply, decode_ply), (encode_spz, decode_spz), (encode_splat, decode_splat)]:
        back = decode(encode(safe))
        assert all(np.isfinite(values).all() for values in (back.means, back.scales, back.opacities, back.sh))


def test_viewer_safe_keeps_a_sane_scene_as_it_is_and_accepts_none():
    gaussians = make_gaussians()
    safe = sanitize_gaussians(gaussians)
    assert np.array_equal(safe.means, gaussians.means) and np.array_equal(safe.scales, gaussians.scales)
    empty = sanitize_gaussians(make_gaussians(0))
    assert len(empty) == 0
    assert len(decode_ply(encode_ply(empty))) == 0
    assert len(decode_spz(encode_spz(empty))) == 0


def test_a_quaternion_that_is_too_long_to_measure_is_none_and_nobody_is_warned():
    gaussians = make_gaussians(10)
    gaussians.quats[4] = 3e38
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        safe = sanitize_gaussians(gaussians)
    assert np.array_equal(safe.quats[4], [1, 0, 0, 0])
    assert np.allclose(np.linalg.norm(safe.quats, axis=1), 1.0, atol=1e-6)
