"""Gaussians as .spz: what is written reads back within its rounding, byte by byte as published."""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace

import numpy as np
import pytest

from recon.export import SceneFileError
from recon.export.spz import decode_spz, encode_spz
from recon.snapshot import GaussianArrays
from tests.exported import make_gaussians, same_rotations


@pytest.mark.parametrize("num_bases", [1, 4, 9, 16])
def test_spz_round_trip_within_its_rounding(num_bases):
    gaussians = make_gaussians(200, num_bases)
    back = decode_spz(encode_spz(gaussians))
    typical = np.median(np.sort(gaussians.scales, axis=1)[:, 1])
    assert np.allclose(back.means, gaussians.means, rtol=0, atol=typical / 50 + 1e-6)
    assert np.allclose(np.log(back.scales), np.log(gaussians.scales), atol=1 / 32 + 1e-5)
    assert np.allclose(back.opacities, gaussians.opacities, atol=1 / 510 + 1e-6)
    assert same_rotations(back.quats, gaussians.quats, degrees=0.3)
    assert np.allclose(back.sh[:, 0], gaussians.sh[:, 0], atol=1 / 76)
    assert np.allclose(back.sh[:, 1:4], gaussians.sh[:, 1:4], atol=4.01 / 128)
    assert np.allclose(back.sh[:, 4:], gaussians.sh[:, 4:], atol=8.01 / 128)


def test_spz_spends_no_bits_on_digits_that_cannot_be_seen_and_all_it_has_on_tiny_gaussians():
    coarse, fine = (replace(make_gaussians(200, 1), scales=np.full((200, 3), s, np.float32)) for s in (0.5, 1e-9))
    assert len(encode_spz(coarse)) < 0.85 * len(encode_spz(fine))
    atol = np.abs(fine.means).max() * 2.0**-23
    assert np.allclose(decode_spz(encode_spz(fine)).means, fine.means, rtol=0, atol=atol)


def test_spz_bytes_of_one_gaussian_worked_out_by_hand():
    one = GaussianArrays(
        means=np.array([[1.0, 2.0, -3.0]], np.float32),
        quats=np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        scales=np.exp(np.array([[-5.0, 0.0, 2.0]])).astype(np.float32),
        opacities=np.array([0.2], np.float32),
        sh=np.array([[[0, 1, -1], [0.5, 0, 0], [0, 0.25, 0], [0, 0, -0.125]]], np.float32),
        source_frame=np.zeros(1, np.int32),
    )
    raw = gzip.decompress(encode_spz(one))
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", raw[:16])
    assert (magic, version, count, degree, flags, reserved) == (0x5053474E, 3, 1, 1, 0, 0)
    assert bits == 5  # the middle extent is 1, in steps of at most 1/25
    x, y, z = (int.from_bytes(raw[16 + 3 * i : 19 + 3 * i], "little", signed=True) for i in range(3))
    assert (x, y, z) == (1 << 5, -2 << 5, 3 << 5)  # right, up, back
    assert raw[25] == 51
    assert list(raw[26:29]) == [128, 166, 89]  # 127.5 and 127.5 +- 38.25, rounded
    assert list(raw[29:32]) == [80, 160, 192]  # 16 * (log scale + 10)
    assert int.from_bytes(raw[32:36], "little") == 3 << 30  # w is the largest, the others are 0
    assert list(raw[36:]) == [64, 128, 128, 128, 96, 128, 128, 128, 112]  # y and z bases change sign, x's does not


def test_spz_sh_signs_follow_the_turned_axes():
    """Half a turn about x takes our axes to the file's; the bases must have the same parity."""
    from recon.export.spz import _SH_SIGNS

    x, y, z = np.random.default_rng(0).normal(size=(3, 20))
    bases = lambda x, y, z: np.stack(  # noqa: E731
        [
            *(np.ones_like(x), y, z, x),
            *(x * y, y * z, 2 * z * z - x * x - y * y, x * z, x * x - y * y),
            *(y * (3 * x * x - y * y), x * y * z, y * (4 * z * z - x * x - y * y)),
            z * (2 * z * z - 3 * x * x - 3 * y * y),
            *(x * (4 * z * z - x * x - y * y), z * (x * x - y * y), x * (x * x - 3 * y * y)),
        ]
    )
    assert np.allclose(bases(x, -y, -z), _SH_SIGNS[:, None] * bases(x, y, z))


def test_spz_version_2_is_read():
    header = struct.pack("<IIIBBBB", 0x5053474E, 2, 1, 0, 12, 0, 0)
    half = round(127.5 + 127.5 * np.sqrt(0.5))
    body = (4096).to_bytes(3, "little") + (-8192).to_bytes(3, "little", signed=True) + bytes(3)
    body += bytes([128, 128, 128, 128, 160, 160, 160, half, 128, 128])
    back = decode_spz(gzip.compress(header + body))
    assert np.allclose(back.means, [[1, 2, 0]])
    assert same_rotations(back.quats, np.array([[np.sqrt(0.5), np.sqrt(0.5), 0, 0]]), degrees=1.0)


def recompressed(change):
    return lambda data: gzip.compress(change(gzip.decompress(data)))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[: len(data) // 2], "truncated"),
        (lambda data: data[:5], "truncated"),
        (lambda data: b"", "truncated"),
        (lambda data: b"ply\n" + data, "not a .spz file"),
        (recompressed(lambda raw: raw[:-1]), "truncated"),
        (recompressed(lambda raw: raw + b"\0"), "more than"),
        (recompressed(lambda raw: b"GSPN" + raw[4:]), "signature"),
        (recompressed(lambda raw: raw[:4] + b"\4" + raw[5:]), "version 4"),
        (recompressed(lambda raw: raw[:12] + b"\7" + raw[13:]), "degree 7"),
        (recompressed(lambda raw: raw[:8] + b"\xff\xff\xff\xff" + raw[12:]), "impossible header"),
    ],
)
def test_damaged_or_foreign_spz_is_a_clear_error(damage, message):
    with pytest.raises(SceneFileError, match=message):
        decode_spz(damage(encode_spz(make_gaussians())), "scene.spz")
