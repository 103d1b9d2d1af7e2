"""LeRobot's data sets of version 3.0: episodes whose videos lie one behind the other in shared files.

Columns of its Parquet files are read in a process of its own: `pyarrow.py` is that process. A file of some megabytes
may hold a column of billions of values, or a page that is unpacked to gigabytes. What is read is bounded by what the
files say of themselves and, where they lie, by the limits of that process.
Source: LeRobot, `dataset_metadata.py` and `utils.py` of its datasets, codebase version v3.0.
"""

from __future__ import annotations

import importlib.util
import math
import os
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.process import python
from splatnode.capture.process.config import decoder_of, record_in
from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.text import guard_untrusted, sanitize_text

MOST_ROWS = 1_000_000  # of all files together: more episodes than any data set has
_MOST_FILES = 10_000
_REMEMBERED = 16  # answers: a few data sets, of each its cameras
_HEAD = struct.Struct("<cI")  # the kind of an answer, and its rows, or the bytes of the sentence that refuses
COLUMNS, REFUSED, LOST = b"C", b"R", b"L"  # kinds: rows of float64, what is wrong with the files, or the disk's error
_MOST_SAID = 100_000  # bytes of a sentence
_Written = tuple[bytes, int, int]  # a file, when it was last written (ns), and its bytes: another file is read anew
Columns = npt.NDArray[np.float64]  # (rows, columns), NaN where there is no number


class Request(msgspec.Struct, frozen=True):
    """The request that the process gets on its standard input, as MessagePack."""

    files: tuple[bytes, ...]
    names: tuple[str, ...]  # of columns; the first must be there, and each of its rows must have a number; (): all


class Lost(msgspec.Struct, frozen=True):
    """An error of the disk, as the process says it."""

    number: int
    reason: str
    file: str


def column(files: Sequence[Path], name: str, refusal: type[Exception], where: str) -> Columns:
    """(rows,) of all tables in `files`. Raises as `row`."""
    return _table(files, (name,), refusal, where)[:, 0]


def row(
    files: Sequence[Path], name: str, value: int, wanted: Sequence[str], refusal: type[Exception], where: str
) -> tuple[float, ...] | None:
    """The `wanted` columns, NaN where there is none, of the last row that has `value` in the column `name`.

    Tables that did not change are read once. Raises a `refusal` that begins with `where` for what is no such table or
    beyond its bounds, OSError, and ModuleNotFoundError without pyarrow.
    """
    table = _table(files, (name, *wanted), refusal, where)
    places = np.flatnonzero(table[:, 0] == value)
    return tuple(table[places[-1], 1:].tolist()) if len(places) else None


def check_whole(file: Path, refusal: type[Exception], where: str) -> None:
    """Reads all of a table, a row group at a time, and gives nothing: afterwards it can be read so anywhere.

    Raises as `row`.
    """
    _table((file,), (), refusal, where)


def encode_columns(columns: Columns) -> bytes:
    """The answer of the process that has read them."""
    return _HEAD.pack(COLUMNS, len(columns)) + columns.tobytes()


def encode_refusal(kind: bytes, said: bytes) -> bytes:
    """The answer of the process that cannot read them."""
    return _HEAD.pack(kind, len(said[:_MOST_SAID])) + said[:_MOST_SAID]


def _table(files: Sequence[Path], names: tuple[str, ...], refusal: type[Exception], where: str) -> Columns:
    if importlib.util.find_spec("pyarrow") is None:
        folder = where.partition(": ")[0]
        said = f"{folder} is a LeRobot data set, and its tables are read with pyarrow, which is not installed"
        raise ModuleNotFoundError(said, name="pyarrow")
    if len(files) > _MOST_FILES:
        raise refusal(f"{where}: at most {_MOST_FILES} files are read, there are {len(files)}")
    stats = [(os.fsencode(file.absolute()), file.stat()) for file in files]
    kind, content = _answer(tuple((file, stat.st_mtime_ns, stat.st_size) for file, stat in stats), names)
    if kind == LOST:
        lost = decoder_of(Lost).decode(content)
        raise OSError(lost.number, lost.reason, lost.file)
    if kind == REFUSED:
        raise refusal(f"{where}: {sanitize_text(content.decode(errors='replace'), 500)}")
    return np.frombuffer(content, np.float64).reshape(-1, len(names) or 1)


@lru_cache(_REMEMBERED)
def _answer(written: tuple[_Written, ...], names: tuple[str, ...]) -> tuple[bytes, bytes]:
    """The kind of an answer, and what comes with it."""
    request = msgspec.msgpack.encode(Request(tuple(file for file, *_ in written), names))
    most = _HEAD.size + max(_MOST_SAID, MOST_ROWS * len(names) * 8)
    answer, code = python.answer("splatnode.extras.pyarrow", request, most)
    if len(answer) >= _HEAD.size:
        kind, count = _HEAD.unpack_from(answer)
        if len(answer) == _HEAD.size + count * (len(names) * 8 if kind == COLUMNS else 1):
            return kind, answer[_HEAD.size :]
    return REFUSED, f"its tables are damaged, or take too much memory: their reader ended ({code})".encode()


VERSION = "v3.0"
INFO, EPISODES = Path("meta", "info.json"), Path("meta", "episodes")
_MOST_BYTES = 10_000_000  # of info.json
_MOST_RATE = 1000  # frames a second, as of a video
_NUMBER = "episode_index"  # the column
_MOST_NUMBER = 10**9  # of an episode, a chunk or a file
_NAMED = "episode_"  # before an episode's number, in the name of a part
_LONGEST = 1000  # characters of video_path, and of a camera's key in it
_LONGEST_PATH = 4000  # of the two together
_FIELD = re.compile(r"\{(video_key|chunk_index|file_index)(?::0?([0-9]{1,2})d)?\}")


class UnusableDataSet(ValueError):
    """A folder that is no data set that can be read here, or has no such episode; the text says why."""


class Feature(msgspec.Struct, frozen=True):
    dtype: str
    info: dict[str, Any] | None = None
    video_info: dict[str, Any] | None = None

    @property
    def is_film(self) -> bool:
        info = {**(self.video_info or {}), **(self.info or {})}
        return self.dtype == "video" and not (info.get("is_depth_map") or info.get("video.is_depth_map"))


class Info(msgspec.Struct, frozen=True):
    """The fields of meta/info.json that are read."""

    codebase_version: str
    fps: float = 0.0
    features: dict[str, Feature] = {}
    video_path: str | None = None

    @property
    def cameras(self) -> list[str]:
        """The keys of the features that are videos of photographs."""
        return [key for key, feature in self.features.items() if feature.is_film]


@dataclass(frozen=True)
class Film:
    """The video of one camera in one episode."""

    episode: int
    key: str  # of the camera's feature
    video: Path
    from_s: float  # in the video
    to_s: float
    rate: float  # frames a second of the data set, by which it numbers them; 0: it does not say


def is_data_set(folder: Path) -> bool:
    return (folder / INFO).is_file()


def read_info(folder: Path) -> Info:
    """Raises UnusableDataSet where it is of another version, or has no videos; OSError."""
    shown = _quote_path(folder)
    with guard_untrusted(UnusableDataSet, f"{shown}: {INFO}"):
        info = record_in(read_bounded(folder / INFO, _MOST_BYTES, UnusableDataSet, shown), Info)
    if info.codebase_version != VERSION:
        version = sanitize_text(info.codebase_version, 40)
        raise UnusableDataSet(
            f"{shown} must be a LeRobot data set of version {VERSION}, it is of {version}; convert it with LeRobot's "
            "convert_dataset_v21_to_v30, or install a splatnode that reads it"
        )
    if not info.cameras or not info.video_path:
        raise UnusableDataSet(
            f"{shown} has no videos: a feature must be a video; pictures in the tables of data/ are not read"
        )
    return info


def list_parts(folder: Path) -> list[str]:
    """The names of all episodes' cameras, in order, for `film`. Raises as `read_info`, and without pyarrow."""
    cameras = read_info(folder).cameras
    numbers = sorted(set(_numbers(folder)))
    return [f"{episode_name(number)}/{key}" for number in numbers for key in cameras]


def episode_name(number: int) -> str:
    """Returns the name of an episode, as `list_parts` has it."""
    return f"{_NAMED}{number:06d}"


def film(folder: Path, part: str) -> Film:
    """The episode and camera that `list_parts` names so; "3/KEY" is the episode 3, too, and one camera need not be
    named.

    Raises UnusableDataSet where there is none, or where it has no images; OSError, ModuleNotFoundError.
    """
    info = read_info(folder)
    number, key = episode_and_camera(folder, info, part)
    shown = _quote_path(folder)
    wanted = tuple(f"videos/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp", "to_timestamp"))
    found = row(_files(folder), _NUMBER, number, wanted, UnusableDataSet, _where(folder))
    if found is None:
        raise UnusableDataSet(f"{shown} has no episode {number}; it has {len(set(_numbers(folder)))} episodes")
    chunk, file, from_s, to_s = found
    if not all(map(math.isfinite, found)) or not 0.0 <= from_s < to_s:
        raise UnusableDataSet(f"{shown}: episode {number} has no images of {sanitize_text(key)}")
    video = folder / _video(info, key, _whole(chunk, "chunk_index"), _whole(file, "file_index"))
    return Film(number, key, video, from_s, to_s, info.fps if 0 < info.fps <= _MOST_RATE else 0.0)


def episode_and_camera(folder: Path, info: Info, part: str) -> tuple[int, str]:
    """The number and the key that a part names. Raises UnusableDataSet where it names none."""
    said, _, key = part.partition("/")
    number = said.removeprefix(_NAMED)
    key = key or (info.cameras[0] if len(info.cameras) == 1 else "")
    is_number = number.isascii() and number.isdecimal() and len(number) <= len(str(_MOST_NUMBER))
    if not is_number or key not in info.cameras:
        cameras = sanitize_text(", ".join(info.cameras))
        raise UnusableDataSet(
            f"{_quote_path(folder)}: behind the # must be an episode and a camera, as "
            f"{episode_name(0)}/{info.cameras[0]}; got {sanitize_text(part, 100)!r}. The cameras are {cameras}"
        )
    return int(number), key


def _numbers(folder: Path) -> list[int]:
    """Reads the numbers of the episodes. Raises UnusableDataSet where there are none."""
    numbers = column(_files(folder), _NUMBER, UnusableDataSet, _where(folder))
    if not len(numbers):
        raise UnusableDataSet(
            f"{_quote_path(folder)} must have a row for each episode in {EPISODES}/*/*.parquet; what is there has no "
            "rows: record an episode first"
        )
    return [_whole(number, _NUMBER) for number in numbers]


def _whole(number: float, name: str) -> int:
    if not 0 <= number <= _MOST_NUMBER or number != math.floor(number):
        raise UnusableDataSet(f"{name} must be a whole number of 0 to {_MOST_NUMBER}, it is {number:g}")
    return int(number)


def _files(folder: Path) -> list[Path]:
    """Those of meta/episodes. Raises UnusableDataSet where there are none."""
    files = sorted((folder / EPISODES).glob("*/*.parquet"))
    if not files:
        raise UnusableDataSet(
            f"{_quote_path(folder)} must have a row for each episode in {EPISODES}/*/*.parquet; there are no such "
            "files: "
            "copy or download the whole data set, or record an episode first"
        )
    return files


def _quote_path(folder: Path) -> str:
    return f"{sanitize_text(str(folder))!r}"


def _where(folder: Path) -> str:
    return f"{_quote_path(folder)}: {EPISODES}"


def _video(info: Info, key: str, chunk: int, file: int) -> PurePosixPath:
    """The path in the data set, which leads nowhere else."""
    path = PurePosixPath(video_path(info.video_path or "", key, chunk, file))
    if not path.parts or path.is_absolute() or ".." in path.parts or not str(path).isprintable():
        raise UnusableDataSet(
            f"video_path must lead to a file of the data set, it leads to {sanitize_text(path, 200)!r}"
        )
    return path


def video_path(template: str, key: str, chunk: int, file: int) -> str:
    """The template of a data set with its fields filled in; it is a stranger's text, and no format of Python's.

    It may have the fields of LeRobot alone, {video_key}, {chunk_index:03d} and {file_index:03d}, with widths of at most
    two digits. Raises UnusableDataSet.
    """
    if max(len(template), len(key)) > _LONGEST:
        longest = max(len(template), len(key))
        raise UnusableDataSet(f"video_path and a camera's key have at most {_LONGEST} characters, here {longest}")
    if set("{}") & set(_FIELD.sub("", template)):
        raise UnusableDataSet(
            "video_path must have the fields {video_key}, {chunk_index:03d} and {file_index:03d} and no others, "
            f"it is {sanitize_text(template, 200)!r}"
        )
    values = {"video_key": key, "chunk_index": str(chunk), "file_index": str(file)}
    found = _FIELD.sub(lambda field: values[field[1]].rjust(int(field[2] or 0), "0"), template)
    if len(found) > _LONGEST_PATH:
        raise UnusableDataSet(f"video_path must lead to a file of at most {_LONGEST_PATH} characters, not {len(found)}")
    return found
