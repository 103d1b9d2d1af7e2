"""The few photographs of a camera that tell where it stood in a recording, and whether it stood still."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

from splatnode.capture import film
from splatnode.capture.cameras import folder
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.given_lens import assign_lens
from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.capture.process.packages import remedy
from splatnode.capture.process.printable import sanitize_name, sanitize_text
from splatnode.recon.auditing.stations import Film, ImageFiles, StationRecording
from splatnode.recon.locating.photographs import stream_query_frames

_MOST_HELD = 9  # photographs in memory, evenly spread over what was read of a film so far


def load_sample_frames(pictures: ImageFiles | Film, given: Intrinsics | None) -> list[Frame | DroppedFrame]:
    """The photographs; of a film the first, one from about the middle and the last. `given` is their lens.

    At least one: where nothing can be read, it is a dropped frame that says why.
    """
    if isinstance(pictures, ImageFiles):
        return _read_all(stream_query_frames(pictures.paths, given), pictures.paths[0])
    frames = _read_all(_sample_frames(_stream(pictures.path)), pictures.path)
    return frames if given is None else [assign_lens(frame, given) for frame in frames]


def load_first_frames(recordings: Iterable[StationRecording]) -> Iterator[Frame | DroppedFrame]:
    """The first photograph that can be read of each camera in each recording; where there is none, why."""
    for pictures in (each for recording in recordings for each in recording.cameras.values()):
        if isinstance(pictures, ImageFiles):
            frames, path = stream_query_frames(pictures.paths, None), pictures.paths[0]
        else:
            frames, path = _stream(pictures.path), pictures.path
        yield from _read_all(islice((frame for frame in frames if isinstance(frame, Frame)), 1), path)


def _stream(path: Path) -> Iterator[Frame | DroppedFrame]:
    yield from film.stream(path) if film.is_film(path) else folder.stream(folder.Config(folder=path))


def _read_all(frames: Iterator[Frame | DroppedFrame], path: Path) -> list[Frame | DroppedFrame]:
    """All of them; in place of what cannot be read from `path`, why."""
    found: list[Frame | DroppedFrame] = []
    try:
        found += frames
    except ModuleNotFoundError as error:
        reason = f"{error.name} is not installed. {remedy(error.name or '')}"
    except (ValueError, OSError) as error:
        raise_shortage(error)
        reason = str(error)
    else:
        reason = "it holds no photographs"
    return found or [DroppedFrame(sanitize_name(path.name), sanitize_text(reason))]


def _sample_frames(frames: Iterator[Frame | DroppedFrame]) -> Iterator[Frame | DroppedFrame]:
    """The first, one within an eighth of the middle, and the last; what cannot be used only where there is no other.

    However many there are, few are in memory: when these are too many, every second one is given up, and from then on
    every second one is held.
    """
    held: list[tuple[int, Frame]] = []
    unusable: DroppedFrame | None = None
    last, count, step = None, 0, 1
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            unusable = unusable or frame
            continue
        if count % step == 0:
            held.append((count, frame))
        if len(held) > _MOST_HELD:
            held, step = held[::2], 2 * step
        last, count = frame, count + 1
    if last is not None:
        middle, between = min(held, key=lambda each: abs(2 * each[0] - count + 1))
        chosen = {0: held[0][1], middle: between, count - 1: last}
        yield from chosen.values()
    elif unusable is not None:
        yield unusable
