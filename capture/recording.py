"""Frames on disk as they were seen: the same pixels, names, stamps and intrinsics come back.

A recording is a folder with an image file a frame and `splatnode-frames.jsonl`, one line a frame in the order in which
they came. A line is written after its image is whole, so that what a killed recorder leaves is a shorter recording.
Images that came as JPEG or PNG files are kept byte for byte; others become PNG, which loses nothing.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import UNSET, UnsetType

from splatnode.capture.depth_image import MOST_PIXELS, DepthImage, DepthMeta, describe_depth, read_depth
from splatnode.capture.frame import (
    Baseline,
    DroppedFrame,
    Frame,
    FrameMeta,
    RightImage,
    describe_frame,
    grey,
    make_frame,
    read_frame_fields,
)
from splatnode.capture.image_file import MAX_PIXELS, UnusableImage, decode_image, decode_values, read_image_file
from splatnode.capture.process.config import record_in
from splatnode.capture.process.files import read_bounded, sync_folder
from splatnode.capture.process.system import outlast
from splatnode.capture.process.text import LONGEST_NAME, digest_name, guard_untrusted, is_printable, sanitize_text

log = logging.getLogger(__name__)

INDEX = "splatnode-frames.jsonl"
_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
MAX_INDEX_BYTES = 500_000_000  # a million frames and more
_SYNC_EVERY = 30  # frames; a power cut costs at most these


class RecordingError(ValueError):
    """A folder that is no recording; the message names the file and the line."""


class _Right(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A frame's right image: a file of the same folder."""

    baseline: Baseline
    file: str
    sha256: str


class _Depth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A frame's depth image: a file of the same folder, of 16 bits, or of the four bytes of each float as channels.

    A second file has its confidence.
    """

    meta: DepthMeta
    files: Annotated[tuple[str, ...], msgspec.Meta(min_length=1, max_length=2)]
    sha256s: Annotated[tuple[str, ...], msgspec.Meta(min_length=1, max_length=2)]


class _Line(FrameMeta, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="frame"):
    name: str  # these two are told apart from what is damaged below
    stamp_ns: int
    file: str
    sha256: str
    right: _Right | UnsetType = UNSET
    depth: _Depth | UnsetType = UNSET


class _DroppedLine(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="dropped"):
    name: str
    reason: str


class Recorder:
    """Writes a recording into a new or empty folder. Close it, or use it as a context manager."""

    def __init__(self, folder: Path) -> None:
        """Raises ValueError where the folder holds anything, OSError where it cannot be written."""
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise ValueError(f"{folder} is not empty; give a new folder to record into")
        self.folder = folder
        self.frames = 0
        self._index = (folder / INDEX).open("xb")

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._sync()
        empty = not self._index.tell()
        self._index.close()
        if empty:  # a camera that never came: the folder can be recorded into when it does
            (self.folder / INDEX).unlink()

    def write(self, item: Frame | DroppedFrame) -> None:
        """Raises OSError; the frames before it stay."""
        if isinstance(item, DroppedFrame):
            self._append(_DroppedLine(item.name, item.reason))
            return
        content = _file_of(item)
        path = self.folder / f"{self.frames:06d}{'.jpg' if content.startswith(_JPEG) else '.png'}"
        digest = _write(path, content)
        right = UNSET if item.right is None else self._write_right(item.right)
        depth = UNSET if item.depth is None else self._write_depth(item.depth)
        self._append(_Line(file=path.name, sha256=digest, right=right, depth=depth, **describe_frame(item)))
        self.frames += 1
        if self.frames % _SYNC_EVERY == 0:
            self._sync()

    def _write_right(self, right: RightImage) -> _Right:
        path = self.folder / f"{self.frames:06d}-right.png"
        return _Right(right.baseline, path.name, _write(path, _png(right.image)))

    def _write_depth(self, depth: DepthImage) -> _Depth:
        values = depth.values if depth.values.dtype == np.uint16 else _float_bytes(depth.values)
        pictures = {"depth": values} if depth.confidence is None else {"depth": values, "confidence": depth.confidence}
        paths = [self.folder / f"{self.frames:06d}-{what}.png" for what in pictures]
        digests = [_write(path, _png(each)) for path, each in zip(paths, pictures.values(), strict=True)]
        return _Depth(describe_depth(depth), tuple(path.name for path in paths), tuple(digests))

    def _append(self, line: _Line | _DroppedLine) -> None:
        self._index.write(msgspec.json.encode(line) + b"\n")
        self._index.flush()

    def _sync(self) -> None:
        os.fsync(self._index.fileno())
        sync_folder(self.folder)


def _file_of(frame: Frame) -> bytes:
    if frame.encoded is not None and frame.encoded.startswith((_JPEG, _PNG)):
        return frame.encoded
    return _png(cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR).astype(np.uint8, copy=False))


def _float_bytes(values: npt.NDArray) -> npt.NDArray[np.uint8]:
    """(H, W, 4) the bytes of floats (H, W), the lowest first."""
    return np.ascontiguousarray(values, "<f4").view(np.uint8).reshape(*values.shape, 4)


def _png(image: npt.NDArray) -> bytes:
    """Encodes an image (H, W, 3) BGR, (H, W, 4) or (H, W), as PNG."""
    written, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not written:
        raise AssertionError("PNG takes every image of 8 or 16 bits")
    return png.tobytes()


def _write(path: Path, content: bytes) -> str:
    """Whole or not at all; gives the content's SHA-256. Raises OSError that names the file."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.touch(exist_ok=False)  # not what a link of that name leads to
        temporary.write_bytes(content)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error
    return hashlib.sha256(content).hexdigest()


@dataclass(frozen=True)
class FrameRecording:
    folder: Path
    lines: tuple[_Line | _DroppedLine, ...]

    @property
    def names(self) -> list[str]:
        """Returns the names of the recorded frames, in their order."""
        return [line.name for line in self.lines if isinstance(line, _Line)]

    def name_files(self, files: Iterable[str]) -> list[str]:
        """The names of the frames whose images are these files, in their order.

        A right or depth image goes with its frame and is none itself. Raises ValueError for a file of no frame.
        """
        frames = [line for line in self.lines if isinstance(line, _Line)]
        owners = {file: line for line in frames for file in _files_of(line)}
        listed = list(files)
        if missing := [file for file in listed if file not in owners]:
            raise ValueError(
                f"{sanitize_text(missing[0], LONGEST_NAME)!r} is no image of the recording {str(self.folder)!r}, which "
                f"{INDEX} lists; give the folder, or files of its frames"
            )
        return [owners[file].name for file in listed if owners[file].file == file]

    def frames(self, names: tuple[str, ...] = (), max_pixels: int = MAX_PIXELS) -> Iterator[Frame | DroppedFrame]:
        """The frames as they were seen, or those called `names`. Raises ValueError where one of these is missing."""
        missing = [name for name in names if not any(name in (line.name, Path(line.name).stem) for line in self.lines)]
        if missing:
            raise ValueError(f"no frame named {', '.join(missing)} in the recording {str(self.folder)!r}")
        frame_id = 0
        for line in self.lines:
            if names and line.name not in names and Path(line.name).stem not in names:
                continue
            item = self._item(line, frame_id, max_pixels)
            frame_id += isinstance(item, Frame)
            yield item

    def _item(self, line: _Line | _DroppedLine, frame_id: int, max_pixels: int) -> Frame | DroppedFrame:
        if isinstance(line, _DroppedLine):
            return DroppedFrame(line.name, line.reason)
        try:
            content, image, right = outlast(lambda: self._images(line, max_pixels), line.name)
            depth = outlast(lambda: self._depth(line, max_pixels), line.name)
        except UnusableImage as error:
            return DroppedFrame(line.name, str(error))
        except OSError as error:
            return DroppedFrame(line.name, f"cannot be read: {error.strerror}")
        return make_frame(
            frame_id,
            line.name,
            line.stamp_ns,
            image,
            encoded=content,
            right=right,
            depth=depth,
            **read_frame_fields(line),
        )

    def _images(self, line: _Line, max_pixels: int) -> tuple[bytes, npt.NDArray[np.uint8], RightImage | None]:
        """The file's bytes, its image, and what the right camera saw. Raises UnusableImage, OSError."""
        content, image = self._image(line.file, line.sha256, max_pixels)
        if line.right is UNSET:
            return content, image, None
        beside = self._image(line.right.file, line.right.sha256, max_pixels)[1]
        return content, image, RightImage(grey(beside), line.right.baseline)

    def _depth(self, line: _Line, max_pixels: int) -> DepthImage | None:
        """The line's depth image; None where it has none. Raises UnusableImage, OSError."""
        if line.depth is UNSET:
            return None
        arrays = []
        for file, sha256 in zip(line.depth.files, line.depth.sha256s, strict=False):
            content = read_image_file(self.folder / file, max_pixels)
            values = decode_values(content, min(max_pixels, MOST_PIXELS))
            if hashlib.sha256(content).hexdigest() != sha256:
                raise UnusableImage(f"{file} is not the file that was recorded")
            arrays.append(values.view("<f4")[..., 0] if values.ndim == 3 and values.shape[2] == 4 else values)
        try:
            return read_depth(line.depth.meta, arrays)
        except ValueError as error:
            raise UnusableImage(str(error)) from error

    def _image(self, file: str, sha256: str, max_pixels: int) -> tuple[bytes, npt.NDArray[np.uint8]]:
        """The file, and its image (H, W, 3) RGB. Raises UnusableImage where it is not the recorded one, and OSError."""
        content = read_image_file(self.folder / file, max_pixels)
        image = decode_image(content, max_pixels).image
        if hashlib.sha256(content).hexdigest() != sha256:
            raise UnusableImage(f"{file} is not the file that was recorded")
        return content, image


def _sanitize_recorded_name(name: str) -> str:
    """The recorded name, which is printable if it is ours; another one is changed, into one that no other becomes."""
    return name if name and is_printable(name, LONGEST_NAME) else digest_name(name)


def _files_of(line: _Line | _DroppedLine) -> tuple[str, ...]:
    if isinstance(line, _DroppedLine):
        return ()
    right = () if line.right is UNSET else (line.right.file,)
    return (line.file, *right, *(() if line.depth is UNSET else line.depth.files))


def is_recording(folder: Path) -> bool:
    return (folder / INDEX).is_file()


def read(folder: Path) -> FrameRecording:
    """Raises RecordingError where the index is damaged other than at its end, where a recorder may have been killed."""
    lines: list[_Line | _DroppedLine] = []
    content = read_bounded(folder / INDEX, MAX_INDEX_BYTES, RecordingError, str(folder / INDEX))
    whole, _, _unfinished = content.rpartition(b"\n")
    for number, text in enumerate(whole.splitlines(), start=1):
        where = f"{folder / INDEX}, line {number}"
        with guard_untrusted(RecordingError, where):
            line = record_in(text, _Line | _DroppedLine)
        for file in _files_of(line):
            if Path(file).name != file or not is_printable(file, LONGEST_NAME):
                raise RecordingError(f"{where}: {sanitize_text(file, LONGEST_NAME)!r} is not a file of this folder")
        lines.append(msgspec.structs.replace(line, name=_sanitize_recorded_name(line.name)))
    if not lines:
        raise RecordingError(f"the recording {str(folder)!r} is empty")
    return FrameRecording(folder, tuple(lines))
