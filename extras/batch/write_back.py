"""The cameras of a batch beside the data sets and logs that they are of, in the formats of these.

Of a LeRobot data set it is one table, meta/splatnode_cameras.parquet, with a row for each camera of each episode, or
columns of the same names in its own tables. Of an MCAP file it is another one beside it, NAME.splatnode.mcap, or
topics of its own.
"""

from __future__ import annotations

import contextlib
import shutil
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatnode.capture import film
from splatnode.capture.process.files import LOCK, LockHeld, exclusive
from splatnode.extras.batch.batch import OWN_SUFFIX, Outcome
from splatnode.extras.batch.report import BEING_WRITTEN, replacing
from splatnode.extras.cameras.mcap import SUFFIX as MCAP
from splatnode.extras.formats.foxglove import Message, make_calibration, make_pose, make_time
from splatnode.extras.lerobot import data_set
from splatnode.extras.logged.mcap import topics
from splatnode.extras.logged.messages import read_times
from splatnode.recon.result.export import read_cameras
from splatnode.recon.result.snapshot import CameraEstimate

CAMERAS = "cameras.json"
TABLE = Path("meta", "splatnode_cameras.parquet")
_WORLD, _CAMERA = "world", "camera"  # coordinate frames, behind the topic
_INFO, _WARNING = 2, 3  # Foxglove's numbers of levels


@dataclass(frozen=True)
class WriteBackOutcome:
    """The outcome of one data set or log."""

    sentence: str
    failed: bool = False


def write_back(rows: Iterable[Outcome], out: Path, in_place: bool) -> Iterator[WriteBackOutcome]:
    """Writes the cameras of `rows`, whose results lie in `out`; one after the other, what becomes of each file.

    `in_place` adds columns to the tables of a data set, and topics to an MCAP file. Recordings of neither are left.
    What was written before of other episodes, cameras and topics stays. A process that is killed leaves each file as it
    was or whole, and hidden files, which the next call removes.
    """
    found: defaultdict[Path, list[tuple[str, Outcome]]] = defaultdict(list)
    for row in rows:
        file, part = film.file_and_part(Path(row.source))
        if part and not row.has_failed and (file.is_dir() or file.suffix.lower() == MCAP):
            found[file].append((part, row))
    for file, parts in found.items():
        write = _write_log if file.suffix.lower() == MCAP else _write_data_set
        try:
            with _lock_exclusively(file):
                sentence = write(file, parts, out, in_place)
        except LockHeld as error:
            why = f"{error}, which writes there; run this again with --resume when it has ended"
            yield WriteBackOutcome(f"the cameras of {file} were not written back: {why}", failed=True)
        except (OSError, ValueError, ModuleNotFoundError) as error:
            yield WriteBackOutcome(f"the cameras of {file} were not written back: {error}", failed=True)
        else:
            yield WriteBackOutcome(sentence)


@contextlib.contextmanager
def _lock_exclusively(file: Path) -> Iterator[None]:
    """One process at a time writes a log or a data set; what a killed one has left is removed. Raises Held, OSError."""
    if file.is_dir():
        lock, begun = file / "meta" / LOCK, (file / "meta").rglob(f".*{BEING_WRITTEN}")
    else:
        lock = file.with_name(f".{file.name}{LOCK}")
        begun = (file.with_name(f".{name}{BEING_WRITTEN}") for name in (file.name, file.stem + OWN_SUFFIX))
    with exclusive(lock):
        try:
            for leftover in begun:
                leftover.unlink(missing_ok=True)
            yield
        finally:
            lock.unlink(missing_ok=True)


def _write_data_set(folder: Path, parts: Sequence[tuple[str, Outcome]], out: Path, in_place: bool) -> str:
    """Raises OSError, UnusableDataSet, ModuleNotFoundError without pyarrow."""
    from splatnode.extras.batch import pyarrow  # takes half a second, and is an extra

    info = data_set.read_info(folder)
    numbered = [(*data_set.episode_and_camera(folder, info, part), row) for part, row in parts]
    numbered.sort(key=lambda each: each[:2])
    seen = ((episode, key, _make_camera_row(row, out, info.fps)) for episode, key, row in numbered)
    if in_place:
        by_key: defaultdict[str, dict[int, Mapping[str, Any]]] = defaultdict(dict)
        for episode, key, values in seen:
            by_key[key][episode] = values
        files = sorted((folder / data_set.EPISODES).glob("*/*.parquet"))
        for file in files:
            with replacing(file) as temporary:
                pyarrow.write_with_columns(file, temporary, by_key)
        return f"{len(parts)} recordings are columns splatnode/CAMERA/... in {len(files)} tables of {folder}"
    table = folder / TABLE
    rows = ({"episode_index": episode, "camera": key, **values} for episode, key, values in seen)
    with replacing(table) as temporary:
        pyarrow.write_cameras(table, temporary, rows, anew={(episode, key) for episode, key, _ in numbered})
    return f"{len(parts)} recordings are rows of {table}"


def _make_camera_row(row: Outcome, out: Path, rate: float) -> dict[str, Any]:
    """Returns a recording's verdict and its keyframes, with the frames' numbers in the episode."""
    cameras = _cameras(row, out)
    indices = [_index(camera) for camera in cameras]
    return {
        "verdict": row.verdict,
        "message": row.message,
        "rotation_deg": row.rotation_deg,
        "centre_percent": row.centre_percent,
        "focal_percent": row.focal_percent,
        "frame_index": indices,
        "timestamp": [index / rate for index in indices] if rate > 0 else [],
        "T_world_camera": [camera.T_world_camera.ravel().tolist() for camera in cameras],
        "K": [camera.K.ravel().tolist() for camera in cameras],
        "width": [camera.width for camera in cameras],
        "height": [camera.height for camera in cameras],
    }


def _write_log(file: Path, parts: Sequence[tuple[str, Outcome]], out: Path, in_place: bool) -> str:
    """Raises OSError, UnusableLog, ModuleNotFoundError without mcap."""
    from splatnode.extras.batch import mcap

    told: list[Message] = []
    schemas: dict[str, str] = {}
    for topic, row in parts:
        names = {kind: f"{topic}/splatnode/{kind}" for kind in ("pose", "calibration", "verdict")}
        schemas |= {names["pose"]: "PoseInFrame", names["calibration"]: "CameraCalibration", names["verdict"]: "Log"}
        told += _make_topic_messages(file, topic, row, out, names)
    told.sort(key=lambda each: each[1])
    target = file if in_place else file.with_name(file.stem + OWN_SUFFIX)
    with replacing(target) as temporary:
        if target.exists():
            mcap.write_with_messages(target, temporary, told, schemas)
            shutil.copymode(target, temporary)
        else:
            temporary.write_bytes(mcap.encode_messages(told, schemas))
    where = "topics of that file" if in_place else str(target)
    return f"{len(parts)} topics of {file} have cameras in {where}"


def _make_topic_messages(
    file: Path, topic: str, row: Outcome, out: Path, names: Mapping[str, str]
) -> Iterator[Message]:
    """The verdict with the first picture, and of each keyframe its pose and lens: logged when its picture was logged.

    Their own time stamps are those of the pictures' headers, which a simulation may count from its beginning.
    """
    by_index = {_index(camera): camera for camera in _cameras(row, out)}
    logged = next((each for each in topics(file) if each.name == topic), None)
    for index, taken in enumerate(() if logged is None else read_times(file, logged)):
        ns, stamp_ns = taken.log_ns, taken.log_ns if taken.captured_at is None else taken.captured_at.ns
        if index == 0:
            level = _INFO if row.published else _WARNING
            said = {"message": f"{row.verdict}: {row.message}", "name": "splatnode", "file": "", "line": 0}
            yield names["verdict"], ns, {"timestamp": make_time(stamp_ns), "level": level, **said}
        if (camera := by_index.get(index)) is not None:
            placed = {
                "timestamp": make_time(stamp_ns),
                "frame_id": f"{topic}/{_WORLD}",
                "pose": make_pose(camera.T_world_camera),
            }
            yield names["pose"], ns, placed
            yield names["calibration"], ns, make_calibration(camera, stamp_ns, f"{topic}/{_CAMERA}")


def _cameras(row: Outcome, out: Path) -> Sequence[CameraEstimate]:
    return read_cameras(out / row.name / CAMERAS) if row.published else ()


def _index(camera: CameraEstimate) -> int:
    """Returns the frame's number in its topic or episode, with which its name ends."""
    return int(Path(camera.name).stem.rpartition("_")[2])
