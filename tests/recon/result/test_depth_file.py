"""depth.npz is read as it was written, or refused."""

from __future__ import annotations

import io
import warnings
import zipfile

import numpy as np
import pytest

from splatnode.recon.result.export.limits import SceneFileError
from splatnode.recon.result.stored_snapshot import DEPTHS, decode_depths, encode_depths, read_depths

KNOWN = {"a.png": np.arange(12, dtype=np.float16).reshape(3, 4), "ü b.jpg": np.ones((2, 2), np.float16)}


def test_it_is_read_as_it_was(tmp_path):
    (tmp_path / DEPTHS).write_bytes(encode_depths(KNOWN))
    found = read_depths(tmp_path)
    assert list(found) == list(KNOWN) and all(np.array_equal(found[name], KNOWN[name]) for name in KNOWN)


def test_where_there_is_no_file_there_are_none(tmp_path):
    assert read_depths(tmp_path) == {}


def packed(**arrays) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def claiming(shape: tuple[int, ...]) -> bytes:
    """A depth whose header says that there is more than there is."""
    whole, header = packed(names=NAMES), io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f2", "fortran_order": False, "shape": shape})
    file = io.BytesIO(whole)
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("depth_0.npy", header.getvalue() + b"1234")
    return file.getvalue()


NAMES = np.array([b"a"])


@pytest.mark.parametrize(
    "data",
    [
        b"nothing",
        encode_depths(KNOWN)[:-30],
        packed(names=NAMES),
        packed(names=np.array([b"\xff"]), depth_0=KNOWN["a.png"]),
        claiming((2, 2)),
        claiming((1 << 40, 2)),
        packed(names=np.array(["a"]), depth_0=KNOWN["a.png"]),
        packed(names=NAMES, depth_0=np.ones((2, 2))),
        packed(names=NAMES, depth_0=np.ones((2, 2, 1), np.float16)),
        packed(names=NAMES, depth_0=-np.ones((2, 2), np.float16)),
        packed(names=NAMES, depth_0=np.full((2, 2), np.nan, np.float16)),
        packed(names=NAMES, depth_0=np.array([{}], object)),
    ],
)
def test_something_else_is_refused(data):
    with pytest.raises(SceneFileError, match="depth.npz"):
        decode_depths(data)


def test_a_file_of_an_old_python_is_read_without_a_warning(tmp_path):
    file, now = io.BytesIO(), encode_depths(KNOWN)
    with zipfile.ZipFile(io.BytesIO(now)) as archive, zipfile.ZipFile(file, "w") as old:
        for name in archive.namelist():
            old.writestr(name, archive.read(name).replace(b"(2, 2), }", b"(2L, 2),}"))
    assert b"2L" in file.getvalue()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert list(decode_depths(file.getvalue())) == list(KNOWN)
