"""LeRobot data sets of version 3.0, made with pyarrow and PyAV or OpenCV in the layout that LeRobot itself writes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from splatnode.capture.process import python
from splatnode.capture.process.config import decoder_of
from splatnode.extras import lerobot, pyarrow
from tests.support.clips import scheduled_as_before

RATE = 10  # frames a second

Images = Sequence[npt.NDArray[np.uint8]]  # (H, W, 3) RGB


def write(folder: Path, episodes: Sequence[Mapping[str, Images]], codec: str = "", **info: Any) -> Path:
    """Each episode has images by the camera's key, all episodes the same keys; a camera's videos are one file.

    `codec`: one of PyAV's, such as libsvtav1; without, OpenCV writes MPEG-4. `info` replaces parts of meta/info.json.
    """
    keys = list(episodes[0])
    rows: list[dict[str, Any]] = []
    begins = 0
    for index, episode in enumerate(episodes):
        length = len(episode[keys[0]])
        rows.append(
            {
                "episode_index": index,
                "tasks": ["look around"],
                "length": length,
                "data/chunk_index": 0,
                "data/file_index": 0,
                "dataset_from_index": begins,
                "dataset_to_index": begins + length,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        for key in keys:
            rows[-1] |= {
                f"videos/{key}/chunk_index": 0,
                f"videos/{key}/file_index": 0,
                f"videos/{key}/from_timestamp": begins / RATE,
                f"videos/{key}/to_timestamp": (begins + length) / RATE,
            }
        begins += length
    for key in keys:
        images = [image for episode in episodes for image in episode[key]]
        video = folder / "videos" / key / "chunk-000" / "file-000.mp4"
        video.parent.mkdir(parents=True)
        (_by_av if codec else _by_opencv)(video, images, codec)
    _write_tables(folder, rows)
    features = {key: {"dtype": "video", "shape": [*episodes[0][key][0].shape], "names": None} for key in keys}
    told = {
        "codebase_version": "v3.0",
        "robot_type": "so100",
        "total_episodes": len(episodes),
        "total_frames": begins,
        "total_tasks": 1,
        "chunks_size": 1000,
        "fps": RATE,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": {**features, "timestamp": {"dtype": "float32", "shape": [1], "names": None}},
    }
    (folder / "meta" / "info.json").write_text(json.dumps({**told, **info}, indent=4))
    return folder


def read_tables_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets this process read tables: the start of another takes longer than what it reads."""

    def answer(module: str, data: bytes, most: int, *arguments: str) -> tuple[bytes, int]:
        assert module == pyarrow.__name__ and not arguments
        return pyarrow._answer(decoder_of(lerobot.Request).decode(data))[:most], 0

    monkeypatch.setattr(python, "answer", answer)


def _write_tables(folder: Path, rows: Sequence[dict[str, Any]]) -> None:
    episodes = folder / "meta" / "episodes" / "chunk-000"
    episodes.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(list(rows)), episodes / "file-000.parquet", compression="snappy")
    frames = [
        {"timestamp": index / RATE, "frame_index": index, "episode_index": row["episode_index"], "task_index": 0}
        for row in rows
        for index in range(row["length"])
    ]
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(frames), data / "file-000.parquet")


def _by_opencv(video: Path, images: Images, _codec: str) -> None:
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"mp4v"), RATE, (width, height))
    for image in images:
        writer.write(np.ascontiguousarray(image[:, :, ::-1]))
    writer.release()


def _by_av(video: Path, images: Images, codec: str) -> None:
    """As LeRobot encodes: a key frame every second frame, 4:2:0, crf 30."""
    with scheduled_as_before(), av.open(str(video), "w") as container:
        stream: Any = container.add_stream(codec, rate=RATE, options={"g": "2", "crf": "30"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
