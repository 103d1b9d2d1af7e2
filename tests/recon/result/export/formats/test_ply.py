"""Gaussians as .ply: what is written reads back, the layout is the published one, damage is told."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from splatnode.recon.result.export import SceneFileError, read_gaussians
from splatnode.recon.result.export.formats.ply import compute_max_gaussians, compute_ply_bytes, encode_ply
from splatnode.recon.result.export.formats.ply import decode as decode_ply
from splatnode.recon.result.snapshot import GaussianArrays
from tests.support.exported import make_gaussians


@pytest.mark.parametrize("num_bases", [1, 4, 9, 16])
def test_ply_round_trip(num_bases):
    gaussians = make_gaussians(num_bases=num_bases)
    data = encode_ply(gaussians)
    assert len(data) == compute_ply_bytes(len(gaussians), num_bases)
    back = decode_ply(data)
    assert np.array_equal(back.means, gaussians.means)
    assert np.array_equal(back.quats, gaussians.quats)
    assert np.array_equal(back.sh, gaussians.sh)
    assert np.allclose(back.scales, gaussians.scales, rtol=1e-5)
    assert np.allclose(back.opacities, gaussians.opacities, atol=1e-6)


def test_ply_layout_is_the_published_one():
    one = GaussianArrays(
        means=np.array([[1, 2, 3]], np.float32),
        quats=np.array([[0.5, 0.5, -0.5, 0.5]], np.float32),
        scales=np.array([[1.0, np.e, np.e**2]], np.float32),
        opacities=np.array([0.5], np.float32),
        sh=np.arange(12, dtype=np.float32).reshape(1, 4, 3),
        source_frame=np.zeros(1, np.int32),
    )
    header, body = encode_ply(one).split(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 1"]
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    rest = [f"f_rest_{i}" for i in range(9)]
    assert names == (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
        + ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )
    # f_rest holds red's coefficients, then green's, then blue's.
    expected = [1, 2, 3, 0, 0, 0, 0, 1, 2, 3, 6, 9, 4, 7, 10, 5, 8, 11, 0, 0, 1, 2, 0.5, 0.5, -0.5, 0.5]
    assert np.allclose(np.frombuffer(body, "<f4"), expected, atol=1e-6)


@pytest.mark.parametrize("count", [1, 9, 10, 12_345, 99_999, 100_000])
def test_as_many_fit_into_a_ply_of_a_size_as_its_size_says(count):
    exactly = compute_ply_bytes(count, 1)
    assert count - 1 <= compute_max_gaussians(exactly) <= count
    assert compute_ply_bytes(compute_max_gaussians(exactly), 1) <= exactly
    assert compute_max_gaussians(10) == 1


def test_ply_of_another_program_may_have_another_order_and_more_properties():
    names = ["rot_0", "rot_1", "rot_2", "rot_3", "x", "y", "z", "confidence"]
    names += ["f_dc_0", "f_dc_1", "f_dc_2", "scale_0", "scale_1", "scale_2", "opacity"]
    header = ["ply", "format binary_little_endian 1.0", "comment made elsewhere", "element vertex 1"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    values = np.array([1, 0, 0, 0, 7, 8, 9, 99, 0.1, 0.2, 0.3, 0, 0, 0, 0], "<f4")
    back = decode_ply("\n".join(header).encode() + values.tobytes())
    assert back.means.tolist() == [[7, 8, 9]]
    assert back.scales.tolist() == [[1, 1, 1]]
    assert back.opacities.tolist() == [0.5]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:-10], "truncated"),
        (lambda data: data[:100], "header has no end"),
        (lambda data: b"", "not a PLY file"),
        (lambda data: b"\x89PNG" + data, "not a PLY file"),
        (lambda data: data.replace(b"binary_little_endian", b"ascii"), "binary little-endian"),
        (lambda data: data.replace(b"opacity", b"nothing"), "lacks the properties opacity"),
        (lambda data: data.replace(b"f_rest_8", b"f_else_8"), "f_rest"),
        (lambda data: data.replace(b"property float x", b"property list uchar int x"), "no Gaussian scene has"),
        (lambda data: data.replace(b"element vertex", b"element chunk"), "must start with the element vertex"),
        (lambda data: data.replace(b"property float y\n", b"property float x\n"), "malformed header"),
    ],
)
def test_damaged_or_foreign_ply_is_a_clear_error(damage, message):
    with pytest.raises(SceneFileError, match=message):
        decode_ply(damage(encode_ply(make_gaussians())), "scene.ply")


@pytest.mark.parametrize("bits", [0x7FA00000, 0xFFA00000, 0x7F800001, 0x7F7FFFFF])
def test_a_number_that_signals_is_no_warning(tmp_path, bits):
    head, body = encode_ply(make_gaussians(3)).split(b"end_header\n")
    row = len(body) // 3
    odd = np.full(row // 4, bits, "<u4").tobytes()
    path = tmp_path / "scene.ply"
    path.write_bytes(head + b"end_header\n" + body[:row] + odd + body[2 * row :])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(decode_ply(path.read_bytes())) == 3
        assert len(read_gaussians(path)) == 2
