"""Episodes of LeRobot data sets."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from splatnode.capture import film
from splatnode.capture.process import python
from splatnode.capture.video_process import VideoFrame
from splatnode.command_line import main
from splatnode.extras import lerobot as data_set
from splatnode.extras.cameras import lerobot
from splatnode.extras.lerobot import UnusableDataSet, list_parts
from splatnode.recon.replay_source import Request, load_source
from tests.support.lerobot_sets import read_tables_here, write

pq = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")

TOP, WRIST = "observation.images.top", "observation.images.wrist"


def levels(*values: int) -> list[np.ndarray]:
    return [np.full((48, 64, 3), (value, 100, 50), np.uint8) for value in values]


def episodes() -> list[dict[str, list[np.ndarray]]]:
    """Three of 4, 3 and 5 frames. The red of a frame says its place in the file: 20 a frame, the wrist's from 10 on."""
    ranges = ((0, 4), (4, 7), (7, 12))
    return [
        {TOP: levels(*(20 * place for place in range(*each))), WRIST: levels(*(10 + 20 * n for n in range(*each)))}
        for each in ranges
    ]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write(tmp_path_factory.mktemp("lerobot") / "pusht", episodes())


@pytest.fixture
def copy(made, tmp_path):
    return Path(shutil.copytree(made, tmp_path / "copy"))


@pytest.fixture
def unguarded(monkeypatch):
    """Tables are read by this process, which other tests show to be guarded."""
    read_tables_here(monkeypatch)


def frames(folder: Path, part: str) -> list[Any]:
    return list(film.stream(film.part_of(folder, part)))


def reds(found: list[Any]) -> list[float]:
    return [float(frame.image[24, 32, 0]) for frame in found]


def change(folder: Path, **columns: Any) -> None:
    """Other values of columns of the second episode."""
    file = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    rows = pq.read_table(file).to_pylist()
    rows[1] |= {name.replace("__", "/"): value for name, value in columns.items()}
    pq.write_table(pq.read_table(file).from_pylist(rows), file)


def check(found: list[Any]) -> None:
    """The second episode, seen by the wrist's camera."""
    assert [frame.name for frame in found] == [f"episode_000001_{WRIST}_{index:06d}.png" for index in range(3)]
    assert [frame.stamp_ns for frame in found] == [0, 100_000_000, 200_000_000]
    assert np.allclose(reds(found), (90, 110, 130), atol=6)


def test_each_camera_of_each_episode_is_a_film(made):
    assert list_parts(made) == [f"episode_{number:06d}/{key}" for number in range(3) for key in (TOP, WRIST)]
    check(frames(made, f"episode_000001/{WRIST}"))
    check(frames(made, f"1/{WRIST}"))
    assert np.allclose(reds(frames(made, f"2/{TOP}")), (140, 160, 180, 200, 220), atol=6)


@pytest.mark.parametrize("codec", ["libsvtav1", "h264"])
def test_what_lerobot_encodes_is_decoded(tmp_path, codec):
    folder = write(tmp_path / "set", episodes(), codec)
    check(frames(folder, f"1/{WRIST}"))


def numbered(found: list[Any]) -> list[tuple[int, float]]:
    """The number of each frame, in its name, and its seconds."""
    assert all(frame.name == f"episode_000001_{TOP}_{frame.frame_id:06d}.png" for frame in found)
    return [(frame.frame_id, frame.stamp_ns / 1e9) for frame in found]


@pytest.mark.parametrize(("lost", "left"), [((1,), [0, 2]), ((0,), [1, 2]), ((0, 1), [2])])
def test_after_frames_that_cannot_be_decoded_the_numbers_are_the_data_sets(copy, unguarded, lost, left):
    video = copy / "videos" / TOP / "chunk-000" / "file-000.mp4"
    with av.open(str(video)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    data = bytearray(video.read_bytes())
    for pos, size in (packets[4 + index] for index in lost):  # the second episode begins with the fifth frame
        data[pos : pos + size] = bytes(size)
    video.write_bytes(data)
    *found, rest = frames(copy, f"1/{TOP}")
    assert "could not be decoded: it is damaged" in rest.reason
    assert numbered(found) == [(index, index / 10) for index in left]
    assert np.allclose(reds(found), [80 + 20 * index for index in left], atol=6)


@pytest.mark.parametrize("rate", [9.99, 10.01, 10.0, 0.0, 1e300, 5.0])
def test_a_whole_episode_is_numbered_without_gaps_where_the_rates_differ(tmp_path, monkeypatch, unguarded, rate):
    """`rate` is the data set's; the video's, of 10, rounds times to whole frames of its own."""
    folder = write(tmp_path / "set", [{TOP: levels(0)}, {TOP: levels(0, 0)}], fps=rate)
    beside = rate if 9 < rate < 11 else 10.0
    places = [1 + round(index / beside * 10) for index in range(2000)]
    image = levels(0)[0]
    decoded = [VideoFrame(place, place * 10**8, image) for place in places]
    monkeypatch.setattr("splatnode.capture.cameras.video.decode_video", lambda *_: iter(decoded))
    assert [number for number, _ in numbered(frames(folder, f"1/{TOP}"))] == list(range(2000))


def test_another_version_is_refused_by_its_name(copy):
    info = json.loads((copy / "meta" / "info.json").read_text())
    (copy / "meta" / "info.json").write_text(json.dumps({**info, "codebase_version": "v2.1"}))
    for given in (copy, film.part_of(copy, f"0/{TOP}")):
        with pytest.raises(UnusableDataSet, match=r"data set of version v3.0, it is of v2.1; convert it with LeRobot"):
            load_source(Request(given))


def test_a_data_set_without_videos_says_so(copy):
    info = json.loads((copy / "meta" / "info.json").read_text())
    for feature in info["features"].values():
        feature["dtype"] = "image"
    (copy / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(UnusableDataSet, match="has no videos: .* pictures in the tables of data/ are not read"):
        load_source(Request(copy))


def test_a_data_set_without_episodes_says_what_is_missing(copy, unguarded):
    file = copy / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    pq.write_table(pq.read_table(file).slice(0, 0), file)
    expected = r"copy' must have a row for each episode in meta/episodes/\*/\*.parquet; "
    with pytest.raises(UnusableDataSet, match=f"{expected}what is there has no rows: record an episode first"):
        load_source(Request(copy))
    with pytest.raises(UnusableDataSet, match="what is there has no rows"):
        frames(copy, f"1/{TOP}")
    file.unlink()
    for given in (copy, film.part_of(copy, f"1/{TOP}")):
        with pytest.raises(UnusableDataSet, match=f"{expected}there are no such files: copy or download the whole"):
            load_source(Request(given))


def test_without_pyarrow_it_says_what_pyarrow_is_needed_for(copy, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "splatnode.extras.pyarrow", raising=False)
    monkeypatch.delattr("splatnode.extras.pyarrow", raising=False)
    assert main(["replay", str(copy), "--out", str(copy / "out")]) == 69
    said = "copy' is a LeRobot data set, and its tables are read with pyarrow, which is not installed. Run: pip install"
    assert f"{said} 'splatnode[batch]'" in capsys.readouterr().err


def test_tables_are_read_once_until_they_change(copy, monkeypatch):
    answer, asked = python.answer, []
    monkeypatch.setattr(python, "answer", lambda *given: asked.append(given) or answer(*given))
    for number in (0, 1, 2, 0):
        data_set.film(copy, f"{number}/{TOP}")
    assert len(asked) == 1
    change(copy, **{f"videos__{TOP}__from_timestamp": 0.5})
    asked.clear()
    assert data_set.film(copy, f"1/{TOP}").from_s == 0.5 and len(asked) == 1


def test_depth_is_no_camera(copy, unguarded):
    info = json.loads((copy / "meta" / "info.json").read_text())
    info["features"][WRIST]["info"] = {"video.is_depth_map": True}
    (copy / "meta" / "info.json").write_text(json.dumps(info))
    assert list_parts(copy) == [f"episode_{number:06d}/{TOP}" for number in range(3)]
    assert len(frames(copy, "1")) == 3, "the only camera need not be named"


def test_an_episode_without_images_says_so(copy, unguarded):
    change(copy, **{f"videos__{TOP}__to_timestamp": 0.4})
    with pytest.raises(UnusableDataSet, match=f"episode 1 has no images of {TOP}"):
        frames(copy, f"1/{TOP}")
    change(copy, **{f"videos__{TOP}__file_index": None})
    with pytest.raises(UnusableDataSet, match="episode 1 has no images"):
        frames(copy, f"1/{TOP}")
    check(frames(copy, f"1/{WRIST}"))


def test_a_video_that_is_not_there_or_cannot_be_read_says_so(copy, unguarded):
    video = copy / "videos" / TOP / "chunk-000" / "file-000.mp4"
    video.write_bytes(b"no video")
    with pytest.raises(ValueError, match=r"file-000.mp4' is no video that can be decoded, .* between 0.4 and 0.7 s"):
        frames(copy, f"1/{TOP}")
    video.unlink()
    with pytest.raises(FileNotFoundError, match="no file .*file-000.mp4"):
        frames(copy, f"1/{TOP}")


def test_what_is_not_there_is_told_with_what_is(made):
    with pytest.raises(UnusableDataSet, match="has no episode 9; it has 3 episodes"):
        frames(made, f"9/{TOP}")
    with pytest.raises(UnusableDataSet, match=f"got '1/other'. The cameras are {TOP}, {WRIST}"):
        frames(made, "1/other")
    with pytest.raises(ValueError, match="is a LeRobot data set; name an episode and a camera of it, such as"):
        load_source(Request(made))


@pytest.mark.parametrize("path", ["/etc/{video_key}", "../{chunk_index}", "{nothing}", "{file_index:x9}", ".", ""])
def test_a_video_path_leads_nowhere_else(copy, unguarded, path):
    info = json.loads((copy / "meta" / "info.json").read_text())
    (copy / "meta" / "info.json").write_text(json.dumps({**info, "video_path": path}))
    with pytest.raises(UnusableDataSet, match="video_path"):
        frames(copy, f"1/{TOP}")


@pytest.mark.parametrize("content", [b"", b"{}", b"[1]", b'{"codebase_version": 3}'])
def test_an_info_that_is_none_is_told(copy, content):
    (copy / "meta" / "info.json").write_bytes(content)
    with pytest.raises(UnusableDataSet, match="info.json: cannot be read"):
        list_parts(copy)


def test_the_camera_takes_a_configuration(made):
    assert len(list(lerobot.stream(lerobot.Config(made, f"2/{TOP}")))) == 5


@pytest.mark.parametrize(
    "path",
    [
        "{file_index:99999999}.mp4",
        "{video_key:>9999999}",
        "{chunk_index:0999d}",
        "{video_key.__class__}",
        "{video_key!r}",
        "{0}{{",
        "videos/{video_key}/" + "x" * 2000,
        "{video_key}" * 100,
        "a\0{file_index}",
        "%s{video_key}}",
    ],
)
def test_a_video_path_is_no_format_of_pythons(copy, unguarded, path):
    info = json.loads((copy / "meta" / "info.json").read_text())
    (copy / "meta" / "info.json").write_text(json.dumps({**info, "video_path": path}))
    with pytest.raises(UnusableDataSet, match="video_path"):
        data_set.film(copy, f"1/{TOP}")


def test_the_fields_of_lerobot_are_filled_in():
    template = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}-{file_index}.mp4"
    assert data_set.video_path(template, "a.{b}", 7, 1234) == "videos/a.{b}/chunk-007/file-1234-1234.mp4"
