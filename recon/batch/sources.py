"""The recordings that are named on the command line, or that lie in the folders that are."""

from __future__ import annotations

import hashlib
import logging
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatnode.capture import film, recording
from splatnode.capture.cameras import mcap
from splatnode.capture.cameras.folder import image_paths, natural_order
from splatnode.capture.lerobot import data_set
from splatnode.capture.process.bounded_file import read_bounded
from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.capture.process.printable import sanitize_name

log = logging.getLogger(__name__)

VIDEOS = {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpg", ".webm"}
LIST = ".txt"
REPORT = "report.json"  # a folder that has one is a result, whose pictures are no photographs
OWN_SUFFIX = ".splatnode.mcap"  # of what a batch writes beside an MCAP file: no recording
_PHOTOGRAPHS = "images"  # the name of a folder that says nothing of what the photographs show
_LONGEST = 150  # characters of a result folder's name
_DEEPEST = 100  # folders below the one that was named; a path may be 4096 bytes long
_DEEPEST_LIST = 20  # lists that lead to a list
_MOST_LIST_BYTES = 100_000_000
_MARKED = 8  # hexadecimal digits that tell recordings of one name apart


@dataclass(frozen=True)
class BatchRecording:
    """One run of `splatnode replay`."""

    name: str  # of its result folder; no other recording of the batch has it
    source: str  # the absolute path of a folder of photographs, or of a film as `capture/film.py` names it


def recordings(
    sources: Sequence[Path], out: Path | None, own_names: frozenset[str] = frozenset()
) -> list[BatchRecording]:
    """All recordings, once each, in the order of the sources; results that lie in `out` are none.

    A source is a folder of photographs, a video, an MCAP file (each of its image topics is a recording), a LeRobot data
    set (each camera of each episode), one such part, a folder that holds such at any depth, or a text file that names
    sources, one a line. What a list names need not be there, and what a file holds need not be readable: its recording
    fails, and the others go on.
    Raises FileNotFoundError and ValueError for what the command line itself names. Names of `own_names` are not given.
    """
    found: dict[Path, str] = {}
    seen: set[Path] = set()
    for source in sources:
        if not source.exists() and not film.is_film(source):
            raise FileNotFoundError(
                f"{str(source)!r} is not there; give a folder, a video, an MCAP file, a data set, or a list (.txt)"
            )
        before = len(found)
        for path, label in _find_recordings(source, out and out.resolve(), seen):
            found.setdefault(real(path), label)
        if len(found) == before:
            raise ValueError(f"no photographs and no videos in {str(source)!r}, or only some that were named already")
    times = Counter(found.values())
    return [
        BatchRecording(_add_digest(label, path) if times[label] > 1 or label in own_names else label, str(path))
        for path, label in found.items()
    ]


def _find_recordings(
    source: Path, out: Path | None, seen: set[Path], lists: tuple[Path, ...] = ()
) -> Iterator[tuple[Path, str]]:
    """Paths of recordings, each with what it is called; `lists` led to this source. What is in `seen` has been here."""
    if _is(source.is_dir):
        for path in _walk_folder(source, out, seen):
            yield from _parts(path, _label(path, source))
    elif source.suffix.lower() == LIST and _is(source.is_file):
        for path in read_list(source, lists, seen):
            yield from _find_recordings(path, out, seen, (*lists, real(source)))
    elif real(source) not in seen:
        seen.add(real(source))
        yield from _parts(source, _label(source))


def real(path: Path) -> Path:
    """Resolves a path and its links; a circle of links, and a path that is too long, lead to themselves."""
    return Path(os.path.realpath(path))


def _is(asked: Callable[[], bool]) -> bool:
    """The answer; no where the system does not say, as of a name that is too long."""
    try:
        return asked()
    except OSError:
        return False


def _parts(path: Path, label: str) -> Iterator[tuple[Path, str]]:
    """The image topics of an MCAP file, the episodes and cameras of a data set; anything else itself.

    So is a file or a data set that cannot be read: its recording says why.
    """
    try:
        names = list_parts(path)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        raise_shortage(error)
        names = []
    for name in names:
        yield film.part_of(real(path), name), _name([label, *name.split("/")])
    if not names:
        yield path, label


def list_parts(path: Path) -> list[str]:
    """Lists the recordings of an MCAP file or a data set, as `film` names them; none of anything else.

    Raises ValueError, OSError and ModuleNotFoundError where it cannot be read.
    """
    if path.suffix.lower() == film.MCAP and path.is_file():
        return [topic.name for topic in mcap.image_topics(path)]
    return data_set.list_parts(path) if data_set.is_data_set(path) else []


def read_list(path: Path, lists: Collection[Path], seen: set[Path]) -> Iterator[Path]:
    """The paths that a list names, which are relative to its own folder; empty lines and those of a # say nothing.

    A list that is in `seen`, because another one named it, too, names nothing more. Raises ValueError where it is one
    of the resolved `lists`, which led to it, where these are many, and where it is no list; OSError.
    """
    own, shown = real(path), repr(sanitize_name(str(path)))
    if own in lists:
        raise ValueError(f"the list {shown} leads to itself; take it out of what it names")
    if len(lists) >= _DEEPEST_LIST:
        raise ValueError(f"lists may lead to lists {_DEEPEST_LIST} deep, and {shown} lies deeper; name it directly")
    if own in seen:
        return
    seen.add(own)
    for line in read_bounded(path, _MOST_LIST_BYTES, ValueError, f"the list {shown}").splitlines():
        name = os.fsdecode(line.strip())
        if "\0" in name:
            raise ValueError(f"the list {shown} must name a path a line; it has zero bytes, as no path has")
        if name and not name.startswith("#"):
            yield path.parent / name


def _walk_folder(folder: Path, out: Path | None, seen: set[Path]) -> Iterator[Path]:
    """The recordings at and below `folder`, in natural order; links may lead in a circle, and each place counts once.

    A folder that cannot be looked into is one, too: its recording says why.
    """
    under_way = [iter([folder])]
    while under_way:
        path = next(under_way[-1], None)
        if path is None:
            under_way.pop()
        elif not _is(path.is_dir):
            yield path
        elif (place := real(path)) not in seen and place != out:
            seen.add(place)
            try:
                below = _below(path)
            except OSError:
                yield path
                continue
            if below is None:
                yield path
            elif len(under_way) > _DEEPEST:
                log.warning("%s: folders more than %d deep are not looked into", sanitize_name(str(folder)), _DEEPEST)
            else:
                under_way.append(iter(below))


def _below(folder: Path) -> list[Path] | None:
    """The folders, videos and logs in a folder, of a result none; None where it is a recording. Raises OSError."""
    if (folder / REPORT).is_file():
        return []
    if recording.is_recording(folder) or data_set.is_data_set(folder) or image_paths(folder):
        return None
    visible = (
        path for path in folder.iterdir() if not path.name.startswith(".") and not path.name.endswith(OWN_SUFFIX)
    )
    films = {*VIDEOS, film.MCAP}
    chosen = [path for path in visible if _is(path.is_dir) or (path.suffix.lower() in films and _is(path.is_file))]
    return sorted(chosen, key=natural_order)


def _label(path: Path, source: Path | None = None) -> str:
    """Labels a recording by its path below the named source, or by its own name; `images` says nothing."""
    file, part = film.file_and_part(path)
    own = real(file)
    below = [] if source is None else list(path.relative_to(source).parts)
    if not below or below == [_PHOTOGRAPHS]:
        below = [own.parent.name] if own.name == _PHOTOGRAPHS else [own.name]
    elif below[-1] == _PHOTOGRAPHS:
        below.pop()
    if own.suffix.lower() in {*VIDEOS, film.MCAP}:
        below[-1] = Path(below[-1]).stem
    return _name([*below, *part.split("/")])


def _name(parts: Sequence[str]) -> str:
    return sanitize_name("_".join(filter(None, parts)), _LONGEST).lstrip(".") or "recording"


def _add_digest(label: str, path: Path) -> str:
    digest = hashlib.sha256(os.fsencode(path)).hexdigest()[:_MARKED]
    return f"{label}~{digest}"
