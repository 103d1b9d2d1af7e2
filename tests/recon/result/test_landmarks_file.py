"""landmarks.npz is read as it was written, or refused with what to do."""

from __future__ import annotations

import io
import warnings
import zipfile
from dataclasses import fields, replace

import numpy as np
import pytest

from splatnode.recon.result.export.limits import SceneFileError
from splatnode.recon.result.snapshot import KnownLenses, Landmarks
from splatnode.recon.result.stored_snapshot import LANDMARKS, decode_landmarks, encode_landmarks, read_landmarks
from tests.support.exported import make_landmarks


@pytest.fixture
def landmarks() -> Landmarks:
    return make_landmarks()


def changed(data: bytes, **arrays: np.ndarray) -> bytes:
    """The file with other arrays in place of its own."""
    with np.load(io.BytesIO(data)) as found:
        content = {**{name: found[name] for name in found.files}, **arrays}
    file = io.BytesIO()
    np.savez(file, **content)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


def test_what_was_written_is_read(landmarks):
    found = decode_landmarks(encode_landmarks(landmarks))
    for field in fields(Landmarks):
        one, other = getattr(landmarks, field.name), getattr(found, field.name)
        if isinstance(one, np.ndarray):
            assert np.allclose(one, other, atol=1e-6), field.name
        elif isinstance(one, KnownLenses):
            assert np.allclose(one.focals, other.focals) and np.allclose(one.shifts, other.shifts)
        else:
            assert one == other, field.name


def test_a_file_from_before_focal_lengths_had_bounds_is_read(landmarks):
    found = decode_landmarks(encode_landmarks(replace(landmarks, focal_bounds=None)))
    assert found.focal_bounds is None and len(found.points) == 5


def test_it_moves_into_another_world(landmarks):
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = landmarks.transform(2.0, turn, np.array([1.0, 2.0, 3.0]))
    assert np.allclose(moved.points, 2.0 * landmarks.points @ turn.T + [1, 2, 3])
    assert np.allclose(moved.covariances[0], 4.0 * turn @ landmarks.covariances[0] @ turn.T)
    assert np.allclose(moved.Ts_world_camera[0, :3, :3], turn) and np.allclose(
        moved.Ts_world_camera[0, :3, 3], [1, 2, 3]
    )
    assert moved.unit == 2.0 and np.allclose(moved.centre_bounds, [0.02, 0.04]) and not moved.metric


@pytest.mark.parametrize(
    "wrong, said",
    [
        ({"points": np.full((5, 3), np.nan)}, "finite"),
        ({"points": np.zeros((4, 3))}, "covariances must be"),
        ({"points": np.array([["x"] * 3] * 5)}, "points must be"),
        ({"point_of": np.full(9, 5, np.uint32)}, "of its points"),
        ({"photograph_of": np.full(9, 2, np.uint16)}, "of its points and photographs"),
        ({"descriptors": np.zeros((9, 64), np.uint8)}, "descriptors must be"),
        ({"descriptors": np.zeros((9, 128), np.uint16)}, "bytes"),
        ({"descriptors": np.full((9, 128), 255, np.uint8)}, "bytes of at most 127 and a norm up to 181"),
        ({"descriptors": np.full((9, 128), 127, np.uint8)}, "bytes of at most 127 and a norm up to 181"),
        ({"descriptors": np.full((9, 128), 17, np.uint8)}, "bytes of at most 127 and a norm up to 181"),
        ({"scale": np.array([0.4, 0.0, 0.0])}, "positive"),
        ({"bounds": np.full((2, 2), -1.0)}, "positive"),
        ({"focal_bounds": np.full(2, -1.0)}, "positive"),
        ({"focal_bounds": np.full(3, 1.0)}, "focal_bounds must be"),
        ({"Ts_world_camera": np.tile(2.0 * np.eye(4), (2, 1, 1))}, "rigid motion"),
        ({"covariances": np.full((5, 6), 1e30)}, "within"),
        ({"names": np.array([{}, {}], object)}, "damaged"),
    ],
)
def test_what_cannot_be_is_refused(landmarks, wrong, said):
    with pytest.raises(SceneFileError, match=said):
        decode_landmarks(changed(encode_landmarks(landmarks), **wrong), "given.npz")


def test_a_damaged_file_is_named(landmarks, tmp_path):
    data = encode_landmarks(landmarks)
    for damaged in (b"", b"nothing of the kind", data[: len(data) // 2], data[:300] + b"xyz" + data[303:]):
        (tmp_path / LANDMARKS).write_bytes(damaged)
        with pytest.raises(SceneFileError, match=LANDMARKS):
            read_landmarks(tmp_path)


def test_a_covariance_that_is_none_does_no_harm(landmarks):
    found = decode_landmarks(changed(encode_landmarks(landmarks), covariances=np.full((5, 6), -1.0)))
    assert np.linalg.eigvalsh(found.covariances).min() > -1e-9


def test_a_file_that_would_fill_the_memory_is_not_unpacked(landmarks):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", bytes(65 << 20))
    with pytest.raises(SceneFileError, match="at most"):
        decode_landmarks(file.getvalue())


def test_a_result_without_landmarks_says_what_to_do(tmp_path):
    with pytest.raises(FileNotFoundError, match="not a result of splatnode"):
        read_landmarks(tmp_path)
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match="holds no scene"):
        read_landmarks(tmp_path)
    (tmp_path / "scene.ply").write_text("")
    with pytest.raises(FileNotFoundError, match="Reconstruct the photographs again"):
        read_landmarks(tmp_path)


def test_sides_that_no_array_has_are_refused_and_nobody_is_warned(landmarks):
    content = io.BytesIO()
    head = b"{'descr': '<f4', 'fortran_order': False, 'shape': (9223372036854775808, 6), }"
    with zipfile.ZipFile(io.BytesIO(encode_landmarks(landmarks))) as old, zipfile.ZipFile(content, "w") as new:
        for name in old.namelist():
            points = b"\x93NUMPY\1\0" + len(head).to_bytes(2, "little") + head
            new.writestr(name, points if name == "points.npy" else old.read(name))
    with warnings.catch_warnings(record=True) as said, pytest.raises(SceneFileError, match="landmarks.npz"):
        warnings.simplefilter("always")
        decode_landmarks(content.getvalue())
    assert said == []
