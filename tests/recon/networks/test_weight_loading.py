"""Files of weights that are packed, hollow, or of something else than plain numbers."""

from __future__ import annotations

import io
import json
import struct
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import pytest
import torch

from splatnode.recon.networks import read_weights


def packed(tensors: dict, folder: Path) -> Path:
    """A checkpoint whose parts are deflated, as PyTorch never writes them."""
    whole = io.BytesIO()
    torch.save(tensors, whole)
    path = folder / "a.pth"
    with zipfile.ZipFile(whole) as archive, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        for part in archive.namelist():
            target.writestr(part, archive.read(part))
    return path


def safetensors(header: object, data: bytes = b"") -> bytes:
    told = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(told)) + told + data


def test_a_packed_checkpoint_is_not_unpacked(tmp_path):
    path = packed({"a": torch.zeros(10_000_000)}, tmp_path)
    assert path.stat().st_size < 100_000
    with pytest.raises(ValueError, match="is packed, as no checkpoint of PyTorch is: it was not unpacked"):
        read_weights(path)


def test_a_tensor_larger_than_its_bytes_is_refused(tmp_path):
    torch.save({"a": torch.zeros(1).expand(10**12)}, tmp_path / "a.pth")
    with pytest.raises(
        ValueError, match=r"holds 4 bytes of a \(1000000000000,\), fewer than it needs; take the official"
    ):
        read_weights(tmp_path / "a.pth")


@pytest.mark.parametrize("protocol", [3, 4])
def test_another_protocol_of_pickle_is_no_warning(tmp_path, protocol):
    torch.save({"a": torch.ones(2)}, tmp_path / "a.pth", pickle_protocol=protocol)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            assert read_weights(tmp_path / "a.pth")["a"].tolist() == [1.0, 1.0]
        except ValueError as error:
            assert str(error).endswith("take the official file") or "fetch it again" in str(error)
            assert "Detected pickle protocol" not in str(error)


@pytest.mark.parametrize("kind", ["sparse", "meta"])
def test_what_is_no_plain_tensor_is_refused(tmp_path, kind):
    hollow = torch.zeros(3, device="meta") if kind == "meta" else torch.eye(3).to_sparse()
    torch.save({"a": hollow}, tmp_path / "a.pth")
    with pytest.raises(ValueError, match="must hold plain tensors, a is none|was not loaded|damaged"):
        read_weights(tmp_path / "a.pth")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        struct.pack("<Q", 2**63),
        struct.pack("<Q", 10**8 - 1) + b"{",
        safetensors(b"[" * 100_000),
        safetensors({"a": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 4]}}, bytes(4)),
        safetensors({"a": {"dtype": "F32", "shape": [2**33, 2**33], "data_offsets": [0, 4]}}, bytes(4)),
        safetensors({"a": {"dtype": "F32", "shape": [1], "data_offsets": [4, 0]}}, bytes(4)),
        safetensors({"a": {"dtype": "X7", "shape": [1], "data_offsets": [0, 4]}}, bytes(4)),
        safetensors({name: {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]} for name in "ab"}, bytes(4)),
    ],
)
def test_headers_of_safetensors_that_lie_are_refused(tmp_path, content):
    pytest.importorskip("safetensors")
    (tmp_path / "a.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match="is damaged or not a safetensors file; fetch it again"):
        read_weights(tmp_path / "a.safetensors")


def test_plain_weights_of_both_kinds_are_read(tmp_path):
    weights = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.arange(4.0)[1:3]}
    torch.save({"model": weights}, tmp_path / "a.pth")
    save_file = pytest.importorskip("safetensors.torch").save_file
    save_file({name: tensor.contiguous() for name, tensor in weights.items()}, tmp_path / "a.safetensors")
    for name in ("a.pth", "a.safetensors"):
        found = read_weights(tmp_path / name)
        assert all(torch.equal(found[key], value) for key, value in weights.items())


def test_a_length_in_a_pickle_allocates_no_more_than_the_file_holds(tmp_path):
    path = tmp_path / "a.pth"
    header = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.\x80\x02}q\x00."
    path.write_bytes(header + b"\x80\x02}X" + (2**31 - 1).to_bytes(4, "little") + b"name")
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="not a PyTorch checkpoint"):
            read_weights(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 26  # of 2 GB that the file asks for
    finally:
        tracemalloc.stop()


def test_an_archive_over_several_disks_is_refused(tmp_path):
    path = tmp_path / "a.pth"
    torch.save({"a": torch.zeros(3)}, path)
    data = path.read_bytes()
    at = data.rindex(b"PK\x05\x06")
    locator = b"PK\x06\x07" + (0).to_bytes(4, "little") + (0).to_bytes(8, "little") + (7).to_bytes(4, "little")
    path.write_bytes(data[:at] + locator + data[at:])
    with pytest.raises(ValueError, match="damaged or not a PyTorch checkpoint"):
        read_weights(path)
