"""The recordings that are named on the command line, or that lie in the folders that are."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatnode.capture import film, recording
from splatnode.capture.cameras import mcap
from splatnode.capture.cameras.folder import image_paths, natural_order
from splatnode.capture.lerobot import data_set
from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.capture.process.printable import printable_name

VIDEOS = {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpg", ".webm"}
LIST = ".txt"
REPORT = "report.json"  # a folder that has one is a result, whose pictures are no photographs
OWN_SUFFIX = ".splatnode.mcap"  # of what a batch writes beside an MCAP file: no recording
_PHOTOGRAPHS = "images"  # the name of a folder that says nothing of what the photographs show
_LONGEST = 150  # characters of a result folder's name
_MARKED = 8  # hexadecimal digits that tell recordings of one name apart


@dataclass(frozen=True)
class Recording:
    """One run of `splatnode replay`."""

    name: str  # of its result folder; no other recording of the batch has it
    source: str  # the absolute path of a folder of photographs, or of a film as `capture/film.py` names it


def recordings(sources: Sequence[Path], out: Path | None, own_names: frozenset[str] = frozenset()) -> list[Recording]:
    """All recordings, once each, in the order of the sources; results that lie in `out` are none.

    A source is a folder of photographs, a video, an MCAP file (each of its image topics is a recording), a LeRobot data
    set (each camera of each episode), one such part, a folder that holds such at any depth, or a text file that names
    sources, one a line. What a list names need not be there, and what a file holds need not be readable: its recording
    fails, and the others go on.
    Raises FileNotFoundError and ValueError for what the command line itself names. Names of `own_names` are not given.
    """
    found: dict[Path, str] = {}
    for source in sources:
        if not source.exists() and not film.is_film(source):
            raise FileNotFoundError(
                f"{str(source)!r} is not there; give a folder, a video, an MCAP file, a data set, or a list (.txt)"
            )
        before = len(found)
        for path, label in _found(source, out and out.resolve()):
            found.setdefault(path.resolve(), label)
        if len(found) == before:
            raise ValueError(f"no photographs and no videos in {str(source)!r}, or only some that were named already")
    times = Counter(found.values())
    return [
        Recording(_marked(label, path) if times[label] > 1 or label in own_names else label, str(path))
        for path, label in found.items()
    ]


def _found(source: Path, out: Path | None, lists: tuple[Path, ...] = ()) -> Iterator[tuple[Path, str]]:
    """Paths of recordings, each with what it is called; `lists` led to this source."""
    if source.is_dir():
        for path in _walked(source, out, set()):
            yield from _parts(path, _label(path, source))
    elif source.suffix.lower() == LIST and source.is_file():
        for path in listed(source, lists):
            yield from _found(path, out, (*lists, source.resolve()))
    else:
        yield from _parts(source, _label(source))


def _parts(path: Path, label: str) -> Iterator[tuple[Path, str]]:
    """The image topics of an MCAP file, the episodes and cameras of a data set; anything else itself.

    So is a file or a data set that cannot be read: its recording says why.
    """
    try:
        names = parts(path)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        raise_shortage(error)
        names = []
    for name in names:
        yield film.part_of(path.resolve(), name), _name([label, *name.split("/")])
    if not names:
        yield path, label


def parts(path: Path) -> list[str]:
    """What recordings an MCAP file or a data set holds, as `film` names them; none of anything else.

    Raises ValueError, OSError and ModuleNotFoundError where it cannot be read.
    """
    if path.suffix.lower() == film.MCAP and path.is_file():
        return [topic.name for topic in mcap.image_topics(path)]
    return data_set.parts(path) if data_set.is_data_set(path) else []


def listed(path: Path, lists: Collection[Path]) -> Iterator[Path]:
    """The paths that a list names, which are relative to its own folder; empty lines and those of a # say nothing.

    Raises ValueError where it is one of the resolved `lists`, which led to it.
    """
    if path.resolve() in lists:
        raise ValueError(f"the list {printable_name(str(path))!r} leads to itself; take it out of what it names")
    for line in path.read_bytes().splitlines():
        name = os.fsdecode(line.strip())
        if name and not name.startswith("#"):
            yield path.parent / name


def _walked(folder: Path, out: Path | None, seen: set[Path]) -> Iterator[Path]:
    real = folder.resolve()
    if real in seen or real == out or (folder / REPORT).is_file():
        return
    seen.add(real)  # links may lead in a circle
    if recording.is_recording(folder) or data_set.is_data_set(folder) or image_paths(folder):
        yield folder
        return
    for path in sorted(folder.iterdir(), key=natural_order):
        if path.name.startswith(".") or path.name.endswith(OWN_SUFFIX):
            continue
        if path.is_dir():
            yield from _walked(path, out, seen)
        elif path.suffix.lower() in {*VIDEOS, film.MCAP} and path.is_file():
            yield path


def _label(path: Path, source: Path | None = None) -> str:
    """What a recording is called: its place below the source that was named, or its own name; `images` says nothing."""
    file, part = film.file_and_part(path)
    own = file.resolve()
    below = [] if source is None else list(path.relative_to(source).parts)
    if not below or below == [_PHOTOGRAPHS]:
        below = [own.parent.name] if own.name == _PHOTOGRAPHS else [own.name]
    elif below[-1] == _PHOTOGRAPHS:
        below.pop()
    if own.suffix.lower() in {*VIDEOS, film.MCAP}:
        below[-1] = Path(below[-1]).stem
    return _name([*below, *part.split("/")])


def _name(parts: Sequence[str]) -> str:
    return printable_name("_".join(filter(None, parts)), _LONGEST).lstrip(".") or "recording"


def _marked(label: str, path: Path) -> str:
    digest = hashlib.sha256(os.fsencode(path)).hexdigest()[:_MARKED]
    return f"{label}~{digest}"
