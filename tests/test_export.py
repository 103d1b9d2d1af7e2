"""Scenes as files: what is written reads back, other programs' conventions hold, a failure leaves nothing behind."""

from __future__ import annotations

import errno
import gzip
import hashlib
import json
import os
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.frame import DroppedFrame
from recon.export import ResultWriteError, SceneFileError, export_scene, read_cameras, read_gaussians, write_result
from recon.export import staged as staged_module
from recon.export.cameras import encode_colmap, encode_nerfstudio, encode_tum
from recon.export.ply import decode_ply, encode_ply, most_in_ply, ply_bytes
from recon.export.prepare import SH_C0, viewer_safe
from recon.export.quaternions import matrices_from_quats, quats_from_matrices
from recon.export.splat import decode_splat, encode_splat
from recon.export.spz import decode_spz, encode_spz
from recon.report import build_report, peak_rss_mb
from recon.snapshot import CameraEstimate, GaussianArrays, Snapshot
from recon.verdict import Code, Verdict


def make_gaussians(num_gaussians: int = 50, num_bases: int = 4, seed: int = 0) -> GaussianArrays:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(num_gaussians, 4))
    return GaussianArrays(
        means=rng.uniform(-3, 3, (num_gaussians, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.exp(rng.uniform(-6, -1, (num_gaussians, 3))).astype(np.float32),
        opacities=rng.uniform(0.05, 0.95, num_gaussians).astype(np.float32),
        sh=rng.uniform(-0.7, 0.7, (num_gaussians, num_bases, 3)).astype(np.float32),
        source_frame=np.zeros(num_gaussians, np.int32),
    )


def make_camera(frame_id: int, angle: float = 0.3) -> CameraEstimate:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T_world_camera[:3, 3] = [frame_id, -0.5, 0.25]
    K = np.array([[400.0, 0, 256], [0, 410, 192], [0, 0, 1]])
    return CameraEstimate(f"{frame_id:04d}.jpg", frame_id, T_world_camera, K, 512, 384, 0.1, None)


def make_snapshot(code: Code = Code.OK, publishable: bool = True) -> Snapshot:
    return Snapshot(
        sequence=3,
        verdict=Verdict(code, "Said in one sentence.", "Do this.", ("0001.jpg",), publishable),
        cameras=(make_camera(0), make_camera(2, -0.7)),
        gaussians=make_gaussians(),
        images={},
        dropped=(DroppedFrame("0001.jpg", "blurred"),),
        iterations=200,
        seconds={"poses": 1.5, "optimise": 2.0},
        final=True,
    )


def write(snapshot: Snapshot, folder: Path, **extra) -> Path:
    report = build_report(snapshot, seed=1, preset="fast", peak_rss_mb=100.0)
    return write_result(snapshot, folder, report, **extra)


def same_rotations(a: np.ndarray, b: np.ndarray, degrees: float) -> bool:
    cosine = np.abs((a.astype(np.float64) * b).sum(1)) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    return bool((np.rad2deg(2 * np.arccos(np.minimum(cosine, 1.0))) <= degrees).all())


# --- rotations


def test_quaternions_and_matrices_agree_for_every_largest_component():
    rng = np.random.default_rng(1)
    quats = rng.normal(size=(200, 4))
    quats[:4] = np.eye(4)  # the identity and the three half turns
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    matrices = matrices_from_quats(quats)
    assert np.allclose(matrices @ matrices.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    back = quats_from_matrices(matrices)
    assert np.allclose(np.abs((quats * back).sum(1)), 1.0, atol=1e-12)
    quarter_turn_about_z = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    assert np.allclose(quats_from_matrices(quarter_turn_about_z), [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


# --- .ply


@pytest.mark.parametrize("num_bases", [1, 4, 9, 16])
def test_ply_round_trip(num_bases):
    gaussians = make_gaussians(num_bases=num_bases)
    data = encode_ply(gaussians)
    assert len(data) == ply_bytes(len(gaussians), num_bases)
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
    exactly = ply_bytes(count, 1)
    assert count - 1 <= most_in_ply(exactly) <= count
    assert ply_bytes(most_in_ply(exactly), 1) <= exactly
    assert most_in_ply(10) == 1


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


# --- .splat


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


# --- .spz


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


# --- values that viewers cannot take


def test_viewer_safe_leaves_out_and_clamps_what_would_break_a_viewer():
    gaussians = make_gaussians(100)
    gaussians.means[0] = np.nan
    gaussians.means[1] = 1e9
    gaussians.sh[2, 3, 1] = np.inf
    gaussians.scales[3] = [0.0, 1e12, 0.1]
    gaussians.opacities[4:6] = [0.0, 1.0]
    gaussians.quats[6] = 0.0
    gaussians.quats[7] *= 20.0
    safe = viewer_safe(gaussians)
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
    safe = viewer_safe(gaussians)
    assert np.array_equal(safe.means, gaussians.means) and np.array_equal(safe.scales, gaussians.scales)
    empty = viewer_safe(make_gaussians(0))
    assert len(empty) == 0
    assert len(decode_ply(encode_ply(empty))) == 0
    assert len(decode_spz(encode_spz(empty))) == 0


# --- cameras


def test_colmap_model_is_read_by_colmap(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    snapshot = make_snapshot()
    for name, data in encode_colmap(snapshot.cameras, snapshot.gaussians).items():
        (tmp_path / name).write_bytes(data)
    model = pycolmap.Reconstruction(tmp_path)
    assert len(model.cameras) == 1  # the two images share a calibration
    assert np.allclose(model.cameras[1].params, [400, 410, 256, 192])
    assert len(model.points3D) == len(snapshot.gaussians)
    for camera in snapshot.cameras:
        image = model.find_image_with_name(camera.name)
        assert image is not None
        T_camera_world = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        assert np.allclose(T_camera_world @ camera.T_world_camera, np.eye(4), atol=1e-12)


def test_nerfstudio_cameras_look_along_minus_z():
    camera = make_camera(2)
    frame = json.loads(encode_nerfstudio([camera]))["frames"][0]
    matrix = np.array(frame["transform_matrix"])
    ahead_in_world = camera.T_world_camera @ [0.0, 0.0, 1.0, 0.0]
    down_in_world = camera.T_world_camera @ [0.0, 1.0, 0.0, 0.0]
    assert np.allclose(matrix @ [0, 0, -1, 0], ahead_in_world)
    assert np.allclose(matrix @ [0, -1, 0, 0], down_in_world)
    assert np.allclose(matrix[:3, 3], camera.T_world_camera[:3, 3])
    assert (frame["fl_x"], frame["fl_y"], frame["cx"], frame["cy"]) == (400, 410, 256, 192)
    assert frame["file_path"] == "images/0002.jpg"


def test_tum_trajectory_has_times_positions_and_xyzw():
    camera = make_camera(2, angle=np.pi / 2)
    line = encode_tum([camera], {"0002.jpg": 1_500_000_000}).decode().splitlines()[-1].split()
    assert line[0] == "1.500000000"
    assert np.allclose([float(value) for value in line[1:]], [2, -0.5, 0.25, 0, np.sqrt(0.5), 0, np.sqrt(0.5)])
    assert encode_tum([camera]).decode().splitlines()[-1].startswith("2 2 -0.5")


# --- results


def test_result_holds_every_file_and_a_manifest_of_them(tmp_path):
    manifest_path = write(make_snapshot(), tmp_path, preview=b"PNG bytes")
    manifest = json.loads(manifest_path.read_text())
    expected = {"scene.ply", "cameras.json", "trajectory.tum", "transforms.json", "preview.png", "report.json"}
    expected |= {f"colmap/{name}.txt" for name in ("cameras", "images", "points3D")}
    assert set(manifest["files"]) == expected
    on_disk = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert on_disk == expected | {"manifest.json"}
    for name, entry in manifest["files"].items():
        data = (tmp_path / name).read_bytes()
        assert entry == {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    for name in expected - {"scene.ply", "preview.png"}:
        assert "relative" in (tmp_path / name).read_text(), f"{name} must say that the scale is relative"


def test_report_tells_what_happened():
    report = json.loads(json.dumps(build_report(make_snapshot(), seed=1, preset="fast", peak_rss_mb=100.0)))
    assert report["verdict"]["code"] == "OK" and report["verdict"]["frames"] == ["0001.jpg"]
    assert report["seconds"] == {"poses": 1.5, "optimise": 2.0, "total": 3.5}
    assert report["num_gaussians"] == 50
    assert report["scene_bytes"] == len(encode_ply(make_gaussians()))
    assert report["frames_used"] == ["0000.jpg", "0002.jpg"]
    assert report["frames_dropped"] == [{"name": "0001.jpg", "reason": "blurred"}]
    assert report["cameras"][0]["uncertainty"] == {"rotation_deg": 0.1, "centre_rel": None}
    assert (report["seed"], report["preset"], report["peak_rss_mb"]) == (1, "fast", 100.0)
    assert report["versions"]["numpy"] == np.__version__


def test_refused_scene_is_not_published_and_replaces_an_earlier_one(tmp_path):
    write(make_snapshot(), tmp_path)
    (tmp_path / "transforms.json").write_text("edited by the user")
    write(make_snapshot(Code.NO_PARALLAX, publishable=False), tmp_path)
    left = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert left == {"report.json", "manifest.json", "transforms.json"}  # what the user changed is the user's
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["verdict"]["code"], report["scene_bytes"]) == ("NO_PARALLAX", 0)


def test_manifest_cannot_make_us_remove_a_file_elsewhere(tmp_path):
    outside = tmp_path / "precious.txt"
    outside.write_text("mine")
    folder = tmp_path / "out"
    folder.mkdir()
    digest = hashlib.sha256(b"mine").hexdigest()
    (folder / "manifest.json").write_text(json.dumps({"files": {"../precious.txt": {"sha256": digest}}}))
    write(make_snapshot(), folder)
    assert outside.read_text() == "mine"


@pytest.mark.parametrize("failing", ["scene.ply", "report.json", "manifest.json"])
def test_full_disk_leaves_the_earlier_result_and_no_temporary_file(tmp_path, monkeypatch, failing):
    write(make_snapshot(), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    real = staged_module._write_through

    def full(path: Path, content: bytes) -> None:
        if failing in path.name:
            path.write_bytes(content[: len(content) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(path, content)

    monkeypatch.setattr(staged_module, "_write_through", full)
    changed = replace(make_snapshot(), gaussians=make_gaussians(seed=9))
    with pytest.raises(ResultWriteError, match="Free some space") as caught:
        write(changed, tmp_path)
    assert caught.value.errno == errno.ENOSPC and isinstance(caught.value, OSError)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_the_system_reporting_a_full_disk_surfaces(tmp_path, monkeypatch):
    snapshot = make_snapshot()
    report = build_report(snapshot, seed=0, preset="fast", peak_rss_mb=None)
    real_open = Path.open

    def open_full_device(path: Path, mode: str = "r", *rest, **options):
        return real_open(Path("/dev/full"), "wb") if mode == "xb" else real_open(path, mode, *rest, **options)

    monkeypatch.setattr(Path, "open", open_full_device)
    with pytest.raises(ResultWriteError) as caught:
        write_result(snapshot, tmp_path, report)
    assert caught.value.errno == errno.ENOSPC
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


def test_file_in_place_of_the_folder_is_a_clear_error(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(ResultWriteError, match="cannot write"):
        write(make_snapshot(), tmp_path / "out")
    assert (tmp_path / "out").read_text() == "a file"


# --- conversion


@pytest.mark.parametrize("to", ["ply", "spz", "splat"])
def test_result_is_exported_as_a_scene_that_reads_back(tmp_path, to):
    write(make_snapshot(), tmp_path)
    path = export_scene(tmp_path, to, tmp_path / f"copy.{to}")
    back = read_gaussians(path)
    assert len(back) == 50
    atol = 1e-3 if to == "spz" else 1e-5  # a fiftieth of an extent
    assert np.allclose(np.sort(back.means[:, 0]), np.sort(make_gaussians().means[:, 0]), atol=atol)


def test_result_is_exported_as_cameras(tmp_path):
    write(make_snapshot(), tmp_path)
    export_scene(tmp_path, "colmap", tmp_path / "model")
    assert (tmp_path / "model" / "images.txt").read_bytes() == (tmp_path / "colmap" / "images.txt").read_bytes()
    export_scene(tmp_path / "scene.ply", "nerfstudio", tmp_path / "ns.json")
    assert (tmp_path / "ns.json").read_bytes() == (tmp_path / "transforms.json").read_bytes()
    export_scene(tmp_path, "tum", tmp_path / "t.tum")
    assert (tmp_path / "t.tum").read_bytes() == (tmp_path / "trajectory.tum").read_bytes()


def test_cameras_read_back_exactly(tmp_path):
    write(make_snapshot(), tmp_path)
    for read, camera in zip(read_cameras(tmp_path / "cameras.json"), make_snapshot().cameras, strict=True):
        assert np.array_equal(read.T_world_camera, camera.T_world_camera)
        assert np.array_equal(read.K, camera.K)
        assert (read.name, read.frame_id, read.width, read.height) == (camera.name, camera.frame_id, 512, 384)
        assert (read.rotation_sigma_deg, read.centre_sigma_rel) == (0.1, None)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"cameras": [{"name": "a"}]}', '{"cameras": [1]}'])
def test_foreign_cameras_file_is_a_clear_error(tmp_path, content):
    (tmp_path / "cameras.json").write_text(content)
    with pytest.raises(SceneFileError, match="cameras.json"):
        read_cameras(tmp_path / "cameras.json")


def test_export_of_what_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="splatnode replay"):
        export_scene(tmp_path, "ply", tmp_path / "x.ply")
    with pytest.raises(ValueError, match="one of ply, spz"):
        export_scene(tmp_path, "obj", tmp_path / "x.obj")
    (tmp_path / "scene.txt").write_text("text")
    with pytest.raises(SceneFileError, match="must end with"):
        export_scene(tmp_path / "scene.txt", "ply", tmp_path / "x.ply")


def test_export_needs_no_torch():
    code = "import sys, recon.export, recon.report; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent.parent).returncode == 0


def test_peak_memory_is_this_process_own():
    before = peak_rss_mb()
    if before is None:
        pytest.skip("this system does not tell a process's peak memory")
    block = np.ones(30_000_000, np.uint8) * 2
    after = peak_rss_mb()
    assert after is not None and after >= before and after * 1e6 > block.nbytes
