"""NumPy's archives, Parquet tables and files of weights, as a stranger would make them."""

from __future__ import annotations

import functools
import io
import json
import random
import struct
import zipfile
from typing import Any

import numpy as np

from tests.support.adversary import documents, edges
from tests.support.adversary.stored import Files

_SHAPES = {
    "points": ((2, 3), "<f4"),
    "covariances": ((2, 6), "<f4"),
    "descriptors": ((3, 128), "|u1"),
    "point_of": ((3,), "<u4"),
    "photograph_of": ((3,), "<u2"),
    "Ts_world_camera": ((1, 4, 4), "<f8"),
    "lenses": ((1, 6), "<f8"),
    "bounds": ((1, 2), "<f8"),
    "scale": ((3,), "<f8"),
}
_DTYPES = ("<f4", "<f8", "|u1", "<u4", ">f8", "<c16", "|O", "<U4", "<M8[s]", "|V8", "|b1", "<f2", "<i8")


def landmarks(rng: random.Random) -> bytes:
    """landmarks.npz, each array of which may have another shape, type or number."""
    odd = rng.choice((0.0, 0.05, 0.3))
    arrays: dict[str, bytes] = {}
    for name, (shape, dtype) in _SHAPES.items():
        value = np.broadcast_to(np.eye(4), shape) if name == "Ts_world_camera" else np.zeros(shape)
        value = value + (0.5 if name in ("lenses", "scale", "points") else 0.0)
        arrays[name] = _array(rng, value.astype(dtype), odd)
    arrays["names"] = _array(rng, np.array([b"view_0.png"], np.bytes_), odd)
    return _archive(rng, arrays, odd)


def depths(rng: random.Random) -> bytes:
    """depth.npz in the same way."""
    odd = rng.choice((0.0, 0.05, 0.3))
    count = rng.choice((0, 1, 2))
    arrays = {f"depth_{index}": _array(rng, np.full((3, 4), 0.5, np.float16), odd) for index in range(count)}
    arrays["names"] = _array(rng, np.array([b"view_%d.png" % index for index in range(count)], np.bytes_), odd)
    return _archive(rng, arrays, odd)


def _array(rng: random.Random, array: Any, odd: float) -> bytes:
    """A member of an archive: NumPy's header, in which anything may stand, and the bytes."""
    data, shape, dtype = array.tobytes(), array.shape, array.dtype.str
    if rng.random() < odd:
        action = rng.randrange(4)
        if action == 0:
            shape = tuple(edges.integer(rng) if rng.random() < 0.5 else side for side in shape)
        elif action == 1:
            dtype = rng.choice(_DTYPES)
        elif action == 2 and array.dtype.kind == "f":
            changed = array.copy().reshape(-1)
            if changed.size:
                with np.errstate(all="ignore"):
                    changed[rng.randrange(changed.size)] = edges.number(rng)
            data = changed.tobytes()
        else:
            data = edges.damaged(rng, data, 1)
    head = f"{{'descr': {dtype!r}, 'fortran_order': {rng.random() < odd}, 'shape': {shape!r}, }}"
    if rng.random() < odd / 5:
        head = rng.choice(("(" * 3000, "{}", head[:-3], "__import__('os')", head.replace("'shape'", "'shapes'")))
    text = head.encode("latin-1", "replace")
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text) % 65536) + text + data


def _archive(rng: random.Random, arrays: dict[str, bytes], odd: float) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(
        file, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    ) as zipped:
        for name, data in arrays.items():
            if rng.random() >= odd / 5:
                zipped.writestr(zipfile.ZipInfo(f"{name}.npy"), data)
    data = file.getvalue()
    return edges.damaged(rng, data, 1) if rng.random() < odd else data


@functools.lru_cache(maxsize=1)
def _tables() -> tuple[bytes, ...]:
    """Tables of episodes: a sound one, and some whose columns are of other types or hold odd values."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    key = "videos/cam/"
    sound: dict[str, list[Any]] = {
        "episode_index": [0, 1],
        f"{key}chunk_index": [0, 0],
        f"{key}file_index": [0, 0],
        f"{key}from_timestamp": [0.0, 1.0],
        f"{key}to_timestamp": [1.0, 2.0],
    }
    odd: list[dict[str, list[Any]]] = [sound]
    for name in sound:
        for values in (
            ["a", "b"],
            [None, None],
            [2**62, -1],
            [float("nan"), float("inf")],
            [[1], [2]],
            [{"a": 1}, {"a": 2}],
            [b"\xff", b""],
            [True, False],
        ):
            odd.append(sound | {name: values})
        odd.append({other: values for other, values in sound.items() if other != name})
    found = []
    for table in odd:
        sink = io.BytesIO()
        pq.write_table(pa.table(table), sink, compression="snappy")
        found.append(sink.getvalue())
    return tuple(found)


def data_set(rng: random.Random) -> Files:
    """A LeRobot data set without its videos: what it tells of itself, and its table of episodes."""
    told = {
        "codebase_version": "v3.0",
        "fps": 10,
        "video_path": rng.choice(_VIDEO_PATHS),
        "features": {"cam": {"dtype": "video", "shape": [12, 16, 3]}, "state": {"dtype": "float32"}},
    }
    info = json.dumps(told).encode() if rng.random() < 0.4 else documents.json_file(rng, told)
    table = _tables()[0] if rng.random() < 0.3 else rng.choice(_tables())
    if rng.random() < 0.5:
        table = edges.damaged(rng, table, rng.choice((1, 2)))
    return {"info.json": info, "file-000.parquet": table}


_GOOD = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_VIDEO_PATHS = (
    *[_GOOD] * 12,
    "../{video_key}.mp4",
    "/etc/{video_key}",
    "{video_key.__class__}",
    "{chunk_index:999999}",
    "{chunk_index:300000000}",
    "{0}",
    "{",
    "{video_key!r:>99}",
    "\0",
    "{file_index:{chunk_index}}",
    "",
)


@functools.lru_cache(maxsize=1)
def _checkpoints() -> tuple[bytes, ...]:
    import torch

    found = []
    for content in ({"a": torch.zeros(2)}, {"model": {"a": torch.zeros(2, 3, dtype=torch.float16)}}, [1], {"a": "b"}):
        for old in (False, True):
            file = io.BytesIO()
            torch.save(content, file, _use_new_zipfile_serialization=not old)
            found.append(file.getvalue())
    return tuple(found)


def weights(rng: random.Random) -> Files:
    """A file of weights, PyTorch's of either format or safetensors, mostly damaged."""
    if rng.random() < 0.6:
        tensors = {"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}, "__metadata__": {"format": "pt"}}
        head = documents.json_file(rng, tensors)
        size = len(head) if rng.random() < 0.95 else edges.unsigned(rng, 64)
        return {"weights.safetensors": struct.pack("<Q", size) + head + bytes(rng.choice((8, 8, 0, 9)))}
    data = rng.choice(_checkpoints())
    return {"weights.pth": edges.damaged(rng, data, rng.choice((0, 1, 1, 3)))}
