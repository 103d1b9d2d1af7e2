"""Gaussians as .spz: what is written reads back within its rounding, byte by byte as published."""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.result.export import SceneFileError
from splatnode.recon.result.export.formats.spz import decode as decode_spz
from splatnode.recon.result.export.formats.spz import encode_spz
from splatnode.recon.result.export.limits import minimize_rotations, select_gaussians
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import GaussianArrays
from tests.support.exported import make_gaussians, same_rotations


def in_the_files_order(gaussians: GaussianArrays) -> GaussianArrays:
    """By z, then by y, each rounded to the file's digits, with axes named as the file has them."""
    bits = gzip.decompress(encode_spz(gaussians))[13]
    x_y_z = np.rint(gaussians.means.astype(np.float64) * 2.0**bits)
    return minimize_rotations(select_gaussians(gaussians, np.lexsort((-x_y_z[:, 1], -x_y_z[:, 2]))))


@pytest.mark.parametrize("num_bases", [1, 4, 9, 16])
def test_spz_round_trip_within_its_rounding(num_bases):
    gaussians = in_the_files_order(make_gaussians(200, num_bases))
    back = decode_spz(encode_spz(gaussians))
    typical = np.median(np.sort(gaussians.scales, axis=1)[:, 1])
    assert np.allclose(back.means, gaussians.means, rtol=0, atol=typical / 25 + 1e-6)
    assert np.allclose(np.log(back.scales), np.log(gaussians.scales), atol=1 / 32 + 1e-5)
    assert np.allclose(back.opacities, gaussians.opacities, atol=2 / 255 + 1e-6)
    assert same_rotations(back.quats, gaussians.quats, degrees=1.0)
    assert np.allclose(back.sh[:, 0], gaussians.sh[:, 0], atol=1 / 38)
    assert np.allclose(back.sh[:, 1:4], gaussians.sh[:, 1:4], atol=4.01 / 128)
    assert np.allclose(back.sh[:, 4:], gaussians.sh[:, 4:], atol=8.01 / 128)


def test_the_picture_does_not_depend_on_the_order_and_hardly_on_the_rounding():
    gaussians = make_gaussians(300, 1)
    shuffled = select_gaussians(gaussians, np.random.default_rng(1).permutation(300))
    K, T_world_camera = np.array([[60.0, 0, 40], [0, 60, 30], [0, 0, 1]]), np.eye(4)
    T_world_camera[2, 3] = -8.0
    written, other, exact = (
        render_arrays(each, T_world_camera, K, 80, 60).rgb
        for each in (decode_spz(encode_spz(gaussians)), decode_spz(encode_spz(shuffled)), gaussians)
    )
    assert np.abs(exact).max() > 0.5 and np.abs(written - other).max() < 1e-5
    assert np.sqrt(np.mean((written - exact) ** 2)) < 0.01


def test_spz_of_a_surface_takes_clearly_less_room_than_in_any_order():
    """Bytes that repeat come together: a wall's Gaussians share their depth."""
    wall = make_gaussians(5000, 1)
    wall.means[:, 2] = 3.0 + 0.05 * np.sin(wall.means[:, 0])
    encoded = encode_spz(wall)
    rows = gzip.decompress(encoded)[16:]
    mixed = np.random.default_rng(0).permutation(5000)
    columns = np.split(np.frombuffer(rows, np.uint8), 5000 * np.cumsum([9, 1, 3, 3]))
    in_any_order = b"".join(column.reshape(5000, -1)[mixed].tobytes() for column in columns)
    assert len(encoded) < 0.9 * len(gzip.compress(in_any_order, 9))


def test_spz_spends_no_bits_on_digits_that_cannot_be_seen_and_all_it_has_on_tiny_gaussians():
    coarse, fine = (
        in_the_files_order(replace(make_gaussians(200, 1), scales=np.full((200, 3), scale, np.float32)))
        for scale in (0.5, 1e-9)
    )
    assert len(encode_spz(coarse)) < 0.85 * len(encode_spz(fine))
    atol = np.abs(fine.means).max() * 2.0**-23
    assert np.allclose(decode_spz(encode_spz(fine)).means, fine.means, rtol=0, atol=atol)


def test_spz_bytes_of_one_gaussian_worked_out_by_hand():
    one = GaussianArrays(
        means=np.array([[1.0, 2.0, -3.0]], np.float32),
        quats=np.array([[np.cos(np.deg2rad(8.5)), 0.0, np.sin(np.deg2rad(8.5)), 0.0]], np.float32),
        scales=np.exp(np.array([[-5.0, 0.0, 2.0]])).astype(np.float32),
        opacities=np.array([0.2], np.float32),
        sh=np.array([[[0, 1, -1], [0.5, 0, 0], [0, 0.25, 0], [0, 0, -0.125]]], np.float32),
        source_frame=np.zeros(1, np.int32),
    )
    raw = gzip.decompress(encode_spz(one))
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", raw[:16])
    assert (magic, version, count, degree, flags, reserved) == (0x5053474E, 2, 1, 1, 0, 0)
    assert bits == 4  # the middle extent is 1, in steps of at most 1/12.5
    x, y, z = (int.from_bytes(raw[16 + 3 * i : 19 + 3 * i], "little", signed=True) for i in range(3))
    assert (x, y, z) == (1 << 4, -2 << 4, 3 << 4)  # right, up, back
    assert raw[25] == 52  # 51, in steps of 4
    assert list(raw[26:29]) == [128, 166, 90]  # 127.5 and 127.5 +- 38.25, in steps of 2
    assert list(raw[29:32]) == [80, 160, 192]  # 16 * (log scale + 10)
    assert list(raw[32:35]) == [128, 109, 128]  # 127.5 * (1 + component), of 0, -sin(17 degrees / 2), 0
    assert list(raw[35:]) == [64, 128, 128, 128, 96, 128, 128, 128, 112]  # y and z bases change sign, x's does not


def test_spz_sh_signs_follow_the_turned_axes():
    """Half a turn about x takes our axes to the file's; the bases must have the same parity."""
    from splatnode.recon.result.export.formats.spz import _SH_SIGNS

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


def test_spz_version_3_is_read():
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 0, 12, 0, 0)
    # xyzw of 0.48, 0.8, -0.36, 0: y is the largest, the others' magnitudes are in units of sqrt(1/2) / 511.
    quat = 1 << 30 | 347 << 20 | (1 << 9 | 260) << 10 | 0
    body = bytes(9) + bytes([128, 128, 128, 128, 160, 160, 160]) + quat.to_bytes(4, "little")
    back = decode_spz(gzip.compress(header + body))
    assert same_rotations(back.quats, np.array([[0, 0.48, -0.8, 0.36]]), degrees=0.3)


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
        (
            recompressed(lambda raw: raw[:8] + b"\xff\xff\xff\xff" + raw[12:]),
            "promises 4294967295 Gaussians; at most 10000000 with 4 coefficients",
        ),
    ],
)
def test_damaged_or_foreign_spz_is_a_clear_error(damage, message):
    with pytest.raises(SceneFileError, match=message):
        decode_spz(damage(encode_spz(make_gaussians())), "scene.spz")
