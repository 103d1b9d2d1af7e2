"""Depth images in files, and folders in the layouts of TUM RGB-D, ScanNet and Record3D."""

from __future__ import annotations

import contextlib
import json
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras import folder
from splatnode.capture.cameras.folder import RgbdFolderError, find_rgbd_folder
from splatnode.capture.depth_image import decode_exr, find_depth_files, read_depth_file
from splatnode.capture.frame import Frame
from splatnode.capture.image_file import UnusableImage
from splatnode.recon.replay_source import Request, load_source

STEPS = np.random.default_rng(0).integers(1, 5000, (24, 32)).astype(np.uint16)
METRES = (STEPS / 1000).astype(np.float32)
K = [40.0, 0, 0, 0, 40.0, 0, 31.5, 23.5, 1]


def attribute(name: str, kind: str, data: bytes) -> bytes:
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data


def exr(depth: np.ndarray, compression: int = 3, channels: tuple[str, ...] = ("R",), half: bool = False) -> bytes:
    """An OpenEXR file of scan lines, each channel of which is `depth`."""
    height, width = depth.shape
    dtype, number = (np.dtype("<f2"), 1) if half else (np.dtype("<f4"), 2)
    table = b"".join(name.encode() + b"\0" + struct.pack("<iIii", number, 0, 1, 1) for name in channels) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    head = b"\x76\x2f\x31\x01" + struct.pack("<i", 2) + attribute("channels", "chlist", table)
    head += attribute("compression", "compression", bytes([compression])) + attribute("dataWindow", "box2i", window)
    head += b"\0"
    lines = {0: 1, 2: 1, 3: 16}[compression]
    blocks = []
    for top in range(0, height, lines):
        rows = depth[top : top + lines].astype(dtype)
        raw = b"".join(row.tobytes() * len(channels) for row in rows)
        data = raw
        if compression:
            flat = np.frombuffer(raw, np.uint8)
            split = np.concatenate([flat[::2], flat[1::2]]).astype(np.int64)
            steps = np.concatenate([split[:1], (split[1:] - split[:-1] + 128) & 255]).astype(np.uint8)
            packed = zlib.compress(steps.tobytes())
            data = packed if len(packed) < len(raw) else raw
        blocks.append(struct.pack("<ii", top, len(data)) + data)
    start = len(head) + 8 * len(blocks)
    offsets = [start + sum(map(len, blocks[:i])) for i in range(len(blocks))]
    return head + struct.pack(f"<{len(blocks)}Q", *offsets) + b"".join(blocks)


def write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def photograph(seed: int, width: int = 64, height: int = 48) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


@pytest.mark.parametrize("compression", [0, 2, 3])
@pytest.mark.parametrize("half", [False, True])
def test_an_exr_is_read_as_it_was_written(compression, half):
    smooth = np.add.outer(np.linspace(1, 2, 37), np.linspace(0, 1, 21)).astype(np.float32)
    found = decode_exr(exr(smooth, compression, ("B", "G", "R"), half))
    assert np.array_equal(found, smooth.astype(np.float16).astype(np.float32) if half else smooth)


def test_a_damaged_exr_is_refused_whatever_is_damaged():
    whole, rng = exr(METRES), np.random.default_rng(0)
    for _ in range(300):
        broken = bytearray(whole)
        for at in rng.integers(0, len(whole), 3):
            broken[at] = rng.integers(0, 256)
        for data in (bytes(broken), bytes(broken[: rng.integers(4, len(whole))])):
            with contextlib.suppress(UnusableImage):
                assert decode_exr(data).ndim == 2
    with pytest.raises(UnusableImage, match="channel Z, Y or R"):
        decode_exr(exr(METRES, channels=("A", "B")))
    with pytest.raises(UnusableImage, match="ZIP, ZIPS or not at all"):
        decode_exr(whole.replace(b"compression\0\x01\0\0\0\x03", b"compression\0\x01\0\0\0\x04"))


def test_depth_files_of_each_kind_have_the_same_metres(tmp_path):
    write_png(tmp_path / "a.png", STEPS)
    np.save(tmp_path / "b.npy", METRES)
    (tmp_path / "c.exr").write_bytes(exr(METRES))
    for name in ("a.png", "b.npy", "c.exr"):
        assert read_depth_file(tmp_path / name).metres == pytest.approx(METRES, abs=1e-6)
    for name, data, why in (
        ("d.jpg", b"", "no suffix of depth images"),
        ("e.png", b"no image", "not an image"),
        ("f.npy", b"\x93NUMPY\x01\0\x76\0broken", "no array"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(UnusableImage, match=why):
            read_depth_file(tmp_path / name)
    np.save(tmp_path / "g.npy", np.array([{}], object), allow_pickle=True)
    np.save(tmp_path / "h.npy", METRES)
    whole = (tmp_path / "h.npy").read_bytes()
    (tmp_path / "h.npy").write_bytes(whole.replace(b"(24, 32)", b"(9**9,)"))
    (tmp_path / "i.npy").write_bytes(whole.replace(b"(24, 32)", b"(24,99)"))
    for name in ("g.npy", "h.npy", "i.npy"):
        with pytest.raises(UnusableImage, match="no array|truncated"):
            read_depth_file(tmp_path / name)


def make_tum(root: Path) -> None:
    for index in range(3):
        write_png(root / f"rgb/130.{index}00000.png", photograph(index))
        write_png(root / f"depth/130.{index}10000.png", 5 * STEPS)
    write_png(root / "rgb/131.000000.png", photograph(3))
    times = [f"130.{index}" for index in range(3)]
    (root / "rgb.txt").write_text(
        "# color images\n" + "".join(f"{t}00000 rgb/{t}00000.png\n" for t in times) + "131.000000 rgb/131.000000.png\n"
    )
    (root / "depth.txt").write_text("# depth maps\n" + "".join(f"{t}10000 depth/{t}10000.png\n" for t in times))


def make_scannet(root: Path) -> None:
    for index in range(3):
        write_png(root / f"color/{index}.png", photograph(index))
        write_png(root / f"depth/{index}.png", STEPS)
    (root / "intrinsic").mkdir()
    for name, focal in (("color", 40.0), ("depth", 20.0)):
        matrix = np.eye(4)
        matrix[:2, :3] = [[focal, 0, 15.5], [0, focal, 11.5]]
        np.savetxt(root / f"intrinsic/intrinsic_{name}.txt", matrix)


def make_record3d(root: Path) -> None:
    for index in range(3):
        write_png(root / f"rgb/{index}.png", photograph(index))
        (root / "depth").mkdir(exist_ok=True)
        (root / f"depth/{index}.exr").write_bytes(exr(METRES))
    (root / "metadata.json").write_text(json.dumps({"K": K, "w": 64, "h": 48, "fps": 60, "poses": []}))


LAYOUTS = {"TUM RGB-D": make_tum, "ScanNet": make_scannet, "Record3D": make_record3d}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_folder_in_a_layout_gives_photographs_with_their_depth(tmp_path, layout):
    LAYOUTS[layout](tmp_path)
    found = find_rgbd_folder(tmp_path)
    assert found is not None and found.layout == layout
    for frames in (
        list(folder.stream(folder.Config(folder=tmp_path))),
        list(load_source(Request(tmp_path)).frames),
    ):
        depths = [each.depth for each in frames if isinstance(each, Frame)]
        assert len(depths) == (4 if layout == "TUM RGB-D" else 3)
        if layout == "TUM RGB-D":
            assert depths.pop() is None, "no depth image was taken within 20 ms"
        for depth in depths:
            assert depth is not None and depth.metres == pytest.approx(METRES, abs=1e-4)
            assert depth.is_aligned == (layout != "ScanNet")
    assert load_source(Request(tmp_path)).photographs == found.photographs


def test_the_lenses_of_a_layout_are_those_of_its_files(tmp_path):
    make_record3d(tmp_path / "a")
    make_scannet(tmp_path / "b")
    record3d, scannet = find_rgbd_folder(tmp_path / "a"), find_rgbd_folder(tmp_path / "b")
    assert record3d is not None and scannet is not None and record3d.intrinsics is not None
    assert record3d.intrinsics.K.tolist() == [[40, 0, 32], [0, 40, 24], [0, 0, 1]]
    assert scannet.depth_intrinsics is not None and scannet.depth_intrinsics.fx == 20.0
    (first, *_) = folder.stream(folder.Config(folder=tmp_path / "a"))
    assert isinstance(first, Frame) and first.intrinsics == record3d.intrinsics


def test_another_folder_is_as_it_was(tmp_path):
    write_png(tmp_path / "a.png", photograph(0))
    write_png(tmp_path / "depth/a.png", STEPS)
    assert find_rgbd_folder(tmp_path) is None
    (only,) = folder.stream(folder.Config(folder=tmp_path))
    assert isinstance(only, Frame) and only.depth is None


def test_a_damaged_depth_image_costs_its_depth_alone(tmp_path, caplog):
    make_scannet(tmp_path)
    (tmp_path / "depth/1.png").write_bytes(b"nothing")
    frames = [each for each in folder.stream(folder.Config(folder=tmp_path)) if isinstance(each, Frame)]
    assert [each.depth is None for each in frames] == [False, True, False]
    assert "1.png: its depth image is left out" in caplog.text


@pytest.mark.parametrize("layout", ["TUM RGB-D", "ScanNet"])
def test_depth_of_another_unit_than_the_layouts_is_left_out_with_its_median(tmp_path, caplog, layout):
    LAYOUTS[layout](tmp_path)
    metres = np.random.default_rng(0).integers(1, 4, (48, 64)).astype(np.uint16)
    for path in tmp_path.glob("depth/*.png"):
        write_png(path, metres)
    frames = [each for each in folder.stream(folder.Config(folder=tmp_path)) if isinstance(each, Frame)]
    assert not any(each.depth for each in frames)
    holds = "steps of 0.2 mm" if layout == "TUM RGB-D" else "whole millimetres"
    assert f"left out: depth images of 16 bits hold {holds}; the median is 2: probably metres" in caplog.text


@pytest.mark.parametrize(
    ("text", "why"),
    [("x rgb/a.png\n", "a time and a file"), ("1.0 ../a.png\n", "a file in this folder"), ("#\n", "lists no files")],
)
def test_a_list_that_is_none_is_named(tmp_path, text, why):
    make_tum(tmp_path)
    (tmp_path / "depth.txt").write_text(text)
    with pytest.raises(RgbdFolderError, match=why):
        list(folder.stream(folder.Config(folder=tmp_path)))
    make_scannet(tmp_path / "s")
    (tmp_path / "s/intrinsic/intrinsic_depth.txt").write_text("1 2\n3\n")
    with pytest.raises(RgbdFolderError, match="matrix of 3 or 4 rows"):
        find_rgbd_folder(tmp_path / "s")


@pytest.mark.parametrize(("off_s", "told"), [(0.01, ""), (0.05, "the nearest is +50 ms away"), (-3e4, "-3e+04 s away")])
def test_depth_whose_times_are_off_is_told_with_the_offset(tmp_path, caplog, off_s, told):
    for index in range(4):
        write_png(tmp_path / f"rgb/{index}.png", photograph(index))
        write_png(tmp_path / f"depth/{index}.png", 5 * STEPS)
    for name, off in (("rgb", 0.0), ("depth", off_s)):
        lines = [f"{1e9 + 0.2 * index + off:.6f} {name}/{index}.png\n" for index in range(4)]
        (tmp_path / f"{name}.txt").write_text("".join(lines))
    frames = [each for each in folder.stream(folder.Config(folder=tmp_path)) if isinstance(each, Frame)]
    assert all((each.depth is None) == bool(told) for each in frames)
    assert ("0 of 4 photographs have a depth image within 20 ms" in caplog.text) == bool(told)
    assert told in caplog.text


@pytest.mark.parametrize("layout", ["ScanNet", "Record3D"])
def test_a_layout_whose_depth_has_other_names_is_told(tmp_path, caplog, layout):
    LAYOUTS[layout](tmp_path)
    list(folder.stream(folder.Config(folder=tmp_path)))
    assert "photographs have a depth image" not in caplog.text
    for path in list(tmp_path.glob("depth/[12].*")):
        path.rename(path.with_stem(f"frame-{path.stem}"))
    list(folder.stream(folder.Config(folder=tmp_path)))
    assert "1 of 3 photographs have a depth image: those of other names count for none" in caplog.text


def test_a_folder_with_depth_of_few_photographs_is_told(tmp_path, caplog):
    write_png(tmp_path / "a.png", STEPS)
    assert set(find_depth_files(tmp_path, ["a.jpg", "b.jpg", "c.jpg"])) == {"a.jpg"}
    assert "1 of 3 photographs have a depth image" in caplog.text


def write_lists(folder: Path, rgb: str, depth: str) -> Path:
    (folder / "rgb").mkdir()
    (folder / "rgb.txt").write_text(rgb)
    (folder / "depth.txt").write_text(depth)
    return folder


@pytest.mark.parametrize(
    "line", ["1 .", "1 ./.", "1 ../a.png", "1 /a.png", "1 rgb/a\0.png", "nan rgb/a.png", "1e300 rgb/a.png"]
)
def test_a_list_of_files_leads_nowhere_else(tmp_path, line):
    with pytest.raises(RgbdFolderError, match="line 1"):
        find_rgbd_folder(write_lists(tmp_path, f"{line}\n", "1 depth/a.png\n"))


def test_long_lists_are_associated_in_the_time_of_sorting(tmp_path):
    count = 30_000
    rgb = "".join(f"{i} rgb/{i}.png\n" for i in range(count))
    depth = "".join(f"{i + 0.01:.2f} depth/{i}.png\n" for i in reversed(range(count)))
    found = find_rgbd_folder(write_lists(tmp_path, rgb, depth))
    assert found is not None and len(found.depth_of) == count
    assert found.depth_of["77.png"] == tmp_path / "depth" / "77.png"


def test_a_header_of_npy_that_python_cannot_parse_is_no_lack_of_memory(tmp_path):
    header = b"-" * 9000 + b"1\n"
    path = tmp_path / "a.npy"
    path.write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header)
    with pytest.raises(UnusableImage, match="no array of NumPy"):
        read_depth_file(path)


def test_blocks_of_an_exr_file_are_no_more_than_the_file():
    whole = exr(np.full((64, 8), 2.0, np.float32), compression=0)
    at = len(whole) - sum(8 + 8 * 4 for _ in range(64))  # lines, not compressed
    first = at - 8 * 64
    offsets = struct.unpack_from("<64Q", whole, first)
    shared = whole[:first] + struct.pack("<64Q", *offsets[:1] * 64) + whole[at : at + 40]
    assert decode_exr(whole).shape == (64, 8)
    with pytest.raises(UnusableImage, match="blocks overlap"):
        decode_exr(shared)
