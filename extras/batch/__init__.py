"""Many recordings, each reconstructed by a process of its own; what fails costs only itself.

Here the recordings are found, their commands run, on this machine or on a Ray cluster, and each end is written down;
`command` is the verb: it shows them all, and takes their cameras back to the recordings. It runs without torch.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import math
import os
import shutil
import sys
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import msgspec

from splatnode.capture import film
from splatnode.capture import recording as capture_recording
from splatnode.capture.cameras.folder import image_paths, natural_order
from splatnode.capture.process.arguments import replace_former_words
from splatnode.capture.process.config import record_in, record_of
from splatnode.capture.process.files import open_itself, read_bounded
from splatnode.capture.process.former_names import FLAGS
from splatnode.capture.process.system import SHORT_OF_MEMORY, outlast, raise_shortage
from splatnode.capture.process.terminal import event
from splatnode.capture.process.text import sanitize_name, sanitize_text
from splatnode.extras import lerobot
from splatnode.extras.cameras.mcap import SUFFIX as MCAP
from splatnode.extras.cameras.mcap import image_topics
from splatnode.extras.jobs import NOT_RUN, Child, End, Limits, free_core, other_version, run_processes, wait_for_end
from splatnode.recon.result.export.limits import read_json_file

# batch.jsonl: what a batch is, then a line for each recording that came to an end. Lines are only added.
#
# A line is on the disk before the next recording begins in its place, so that a driver that is killed repeats at most
# what was running. A recording that was run again has a further line, and the last one counts.

# The recordings that are named on the command line, or that lie in the folders that are.

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
    if path.suffix.lower() == MCAP and path.is_file():
        return [topic.name for topic in image_topics(path)]
    return lerobot.list_parts(path) if lerobot.is_data_set(path) else []


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
            except OSError as error:
                raise_shortage(error)
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
    if capture_recording.is_recording(folder) or lerobot.is_data_set(folder) or image_paths(folder):
        return None
    visible = (
        path for path in folder.iterdir() if not path.name.startswith(".") and not path.name.endswith(OWN_SUFFIX)
    )
    films = {*VIDEOS, MCAP}
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
    if own.suffix.lower() in {*VIDEOS, MCAP}:
        below[-1] = Path(below[-1]).stem
    return _name([*below, *part.split("/")])


def _name(parts: Sequence[str]) -> str:
    return sanitize_name("_".join(filter(None, parts)), _LONGEST).lstrip(".") or "recording"


def _add_digest(label: str, path: Path) -> str:
    digest = hashlib.sha256(os.fsencode(path)).hexdigest()[:_MARKED]
    return f"{label}~{digest}"


# What came of a recording: one row of the table, which the result's report.json and the end of its process give.

FAILED = "FAILED"  # beside the codes of verdicts: there is no answer
_SHORT_OF_MEMORY = (SHORT_OF_MEMORY, "running low on memory")  # as a process says it, and as Ray does
_WITH_ANSWER = (0, 65)  # exit codes of a command that has written its report: a scene, or why there is none


class Outcome(msgspec.Struct, frozen=True):
    """One row. What was not measured, or what a failed recording does not have, is None."""

    name: str  # of the recording, and of its result folder
    source: str
    verdict: str  # a code of docs/verdicts.md, or FAILED
    message: str  # the verdict's sentence, or why it failed
    published: bool  # whether there is a scene
    photographs: int | None  # that were placed
    left_out: int | None  # photographs that were not
    rotation_deg: float | None  # the claim, the widest of all cameras, each for 95 %: degrees
    centre_percent: float | None  # of the distance to the scene
    focal_percent: float | None  # of the focal length
    gaussians: int | None
    seconds: float  # from the start of its process to its end, on one core
    reconstruction_s: float | None  # of these, from the first photograph to the scene
    memory_mb: float  # 10^6 bytes, at most
    exit_code: int | None  # None: killed
    ended_at: float  # seconds since 1970

    @property
    def has_failed(self) -> bool:
        return self.verdict == FAILED


class _Verdict(msgspec.Struct, frozen=True):
    code: str
    message: str
    publishable: bool


class _Claim(msgspec.Struct, frozen=True):
    rotation_deg: float
    centre_percent: float
    focal_percent: float


class _Report(msgspec.Struct, frozen=True):
    """The part of report.json that goes into the table."""

    verdict: _Verdict
    bounds: _Claim | None = None
    seconds: dict[str, float] = {}
    frames_used: list[str] | None = None
    frames_dropped: list[dict] | None = None
    num_gaussians: int | None = None
    peak_rss_mb: float | None = None


def read_outcome(recording: BatchRecording, folder: Path, end: End) -> Outcome:
    """The row of a recording whose process has ended and has left its result in `folder`, or none."""
    if end.exit_code not in _WITH_ANSWER:
        return make_failed_outcome(
            recording, end, end.reason or f"ended with exit code {end.exit_code} and said nothing"
        )
    try:
        report = outlast(lambda: record_in(read_json_file(folder / REPORT), _Report), f"{recording.name}'s report")
    except (OSError, ValueError) as error:  # a decoder's errors are ValueErrors
        return make_failed_outcome(recording, end, f"ended with exit code {end.exit_code}, but {REPORT}: {error}")
    claim = report.bounds
    return Outcome(
        **msgspec.structs.asdict(make_failed_outcome(recording, end, ""))
        | {
            "verdict": sanitize_text(report.verdict.code, 100),
            "message": sanitize_text(report.verdict.message),
            "published": report.verdict.publishable,
            "photographs": None if report.frames_used is None else len(report.frames_used),
            "left_out": None if report.frames_dropped is None else len(report.frames_dropped),
            "rotation_deg": claim and claim.rotation_deg,
            "centre_percent": claim and claim.centre_percent,
            "focal_percent": claim and claim.focal_percent,
            "gaussians": report.num_gaussians,
            "reconstruction_s": report.seconds.get("total"),
            "memory_mb": round(max(end.memory_mb, report.peak_rss_mb or 0.0), 1),
        }
    )


def make_failed_outcome(recording: BatchRecording, end: End, reason: str) -> Outcome:
    """The row of a recording that failed, or the beginning of another."""
    return Outcome(
        name=recording.name,
        source=recording.source,
        verdict=FAILED,
        message=sanitize_text(_add_memory_advice(reason)),
        published=False,
        photographs=None,
        left_out=None,
        rotation_deg=None,
        centre_percent=None,
        focal_percent=None,
        gaussians=None,
        seconds=round(end.seconds, 3),
        reconstruction_s=None,
        memory_mb=round(end.memory_mb, 1),
        exit_code=end.exit_code,
        ended_at=round(time.time(), 3),
    )


def _add_memory_advice(reason: str) -> str:
    """The reason, with what a batch can do about it."""
    if any(said in reason for said in _SHORT_OF_MEMORY):
        return f"{reason}; in a batch fewer --cores, or --max-memory, leave more of it"
    return reason


LEDGER = "batch.jsonl"
_FORMAT = 1

Key = tuple[str, str]


class Header(msgspec.Struct, frozen=True):
    """The first line."""

    batch: int  # the version of this format
    command: list[str]  # without the recording and its result folder: all recordings of a batch are run alike


class OtherBatch(ValueError):
    """The ledger that is there is of another batch, or of none."""


class _Last(NamedTuple):
    place: int  # where the last line of a recording begins
    verdict: str


class Ledger:
    """An open ledger. Use it as a context manager."""

    def __init__(self, folder: Path, command: Sequence[str]) -> None:
        """Opens the ledger of `folder`, or begins one. Raises OtherBatch, OSError."""
        self.path = folder / LEDGER
        self._file: IO[bytes] = open_itself(self.path, "a+b")
        self._last: dict[Key, _Last] = {}
        try:
            self._open(list(command))
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, found: Outcome) -> None:
        """Writes a line through to the disk."""
        self._note(found, self._file.seek(0, os.SEEK_END))
        self._write(msgspec.structs.asdict(found))

    def verdict(self, recording: BatchRecording) -> str | None:
        """Returns the verdict of the recording's last run, which may be FAILED; None: it has none."""
        last = self._last.get(_key(recording))
        return last and last.verdict

    def rows(self, wanted: Iterable[BatchRecording]) -> Iterator[Outcome]:
        """The last outcome of each recording, in this order; nothing for one that has none."""
        with self.path.open("rb") as file:
            for last in (self._last.get(_key(recording)) for recording in wanted):
                if last is not None:
                    file.seek(last.place)
                    yield _outcome(file.readline())

    def _open(self, command: list[str]) -> None:
        self._file.seek(0)
        first = self._file.readline()
        if not first.endswith(b"\n"):  # there is none, or its writer was killed
            self._file.truncate(0)
            self._write(msgspec.structs.asdict(Header(_FORMAT, command)))
            return
        self._check(first, command)
        end = place = self._file.tell()
        for line in self._file:
            if line.endswith(b"\n"):  # half a line is what a killed writer leaves
                end = place + len(line)
                self._read(line, place)
            place += len(line)
        self._file.truncate(end)

    def _check(self, first: bytes, command: list[str]) -> None:
        try:
            header = record_of(json.loads(first), Header)
        except ValueError as error:
            raise OtherBatch(f"{self.path} is not the ledger of a batch ({error}); give another --out") from error
        if header.batch != _FORMAT:
            raise OtherBatch(f"{self.path} has format {header.batch}, expected {_FORMAT}; give another --out")
        known, _ = replace_former_words(header.command[1:], {}, FLAGS)  # that a former release began
        if header.command[:1] + known != command:
            raise OtherBatch(
                f"{self.path} is of a batch with other options: {sanitize_text(' '.join(header.command))}. Now they "
                "are "
                f"{' '.join(command)}. Give the same ones, or another --out"
            )

    def _read(self, line: bytes, place: int) -> None:
        try:
            self._note(_outcome(line), place)
        except ValueError as error:  # its recording is run again
            event(log, logging.WARNING, "line_unreadable", file=self.path, byte=place, error=sanitize_text(error))

    def _note(self, found: Outcome, place: int) -> None:
        self._last[_key(found)] = _Last(place, sys.intern(found.verdict))

    def _write(self, record: dict) -> None:
        self._file.write(f"{json.dumps(record)}\n".encode("ascii"))  # a path may have bytes that are no UTF-8
        self._file.flush()
        os.fsync(self._file.fileno())


def _key(of: BatchRecording | Outcome) -> Key:
    return of.name, of.source


def _outcome(line: bytes) -> Outcome:
    """Raises ValueError where the line is none of ours: Python's JSON has numbers that are not finite."""
    found = record_of(json.loads(line), Outcome)
    numbers = [each for each in msgspec.structs.astuple(found) if isinstance(each, float)]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"the numbers of a row must be finite, got {numbers}")
    return found


# Names in the folder of a batch, and how a result gets its own: whole, in place of an earlier one, or not at all.

LOG = "replay.log"  # in a result folder: what its process said; of one that failed NAME.log, beside the results
PARTIAL = ".partial"  # the end of a hidden name, of what is being made
_OLD = ".old"


def partial_folder(out: Path, name: str) -> Path:
    """Returns the folder in which the result `name` is made."""
    return out / f".{name}{PARTIAL}"


def partial_log(out: Path, name: str) -> Path:
    return out / f".{name}.log{PARTIAL}"


def finalize_result(recording: BatchRecording, out: Path, made_as: str, end: End) -> Outcome:
    """Gives the result that was made as `partial_folder(out, made_as)` its name; of a failure what was said is kept."""
    partial, log = partial_folder(out, made_as), partial_log(out, made_as)
    found, final, failed_log = (
        read_outcome(recording, partial, end),
        out / recording.name,
        out / f"{recording.name}.log",
    )
    if found.has_failed:
        os.replace(log, failed_log)
        shutil.rmtree(partial, ignore_errors=True)
        return found
    failed_log.unlink(missing_ok=True)
    os.replace(log, partial / LOG)
    while not _replace_result(partial, final, partial_folder(out, made_as + _OLD)):
        continue
    return found


def _replace_result(partial: Path, final: Path, old: Path) -> bool:
    """Whether `partial` has its name now; not where another run of the same recording was just faster.

    What is there is left by a driver that was killed before it could write the outcome down, or was run again.
    """
    try:
        if final.exists():
            os.replace(final, old)
        os.replace(partial, final)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOENT) or not partial.exists():
            raise
        return False
    finally:
        shutil.rmtree(old, ignore_errors=True)
    return True


def remove_leftovers(out: Path) -> None:
    """Removes what processes that are no more had begun."""
    with os.scandir(out) as entries:
        leftovers = [Path(entry.path) for entry in entries if entry.name[0] == "." and entry.name.endswith(PARTIAL)]
    for path in leftovers:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


# Runs a command for each recording, some at a time; each result is whole or not there, and each failure alone.

Work = Callable[
    [BatchRecording, Path], Sequence[str]
]  # the command that writes a recording's result into this new folder


@dataclass(frozen=True)
class Plan:
    """How recordings are run."""

    out: Path  # the folder of the result folders; this process alone writes there
    cores: tuple[int, ...]  # as many recordings at a time, each on one of these
    limits: Limits


def run_all(todo: Iterable[BatchRecording], work: Work, plan: Plan) -> Generator[Outcome, None, None]:
    """The outcomes as they come; a recording whose outcome is given has its result folder, if it has any.

    What is running when the iterator is closed, or when the process dies, leaves nothing but hidden files, which the
    next call removes.
    """
    remove_leftovers(plan.out)
    take, start = partial(next, iter(todo), None), partial(_start_replay, work, plan.out)
    running = run_processes(take, start, [(core,) for core in plan.cores], plan.limits)
    try:
        for recording, end in running:
            yield finalize_result(recording, plan.out, recording.name, end)
    finally:
        running.close()
        remove_leftovers(plan.out)


def _start_replay(work: Work, out: Path, recording: BatchRecording, cores: Sequence[int]) -> Child:
    return Child.start(work(recording, partial_folder(out, recording.name)), partial_log(out, recording.name), cores)


# The recordings of a batch on a Ray cluster: each is a function of values on a worker.
#
# Its result is whole in a shared folder or a store. It may run more than once for one recording, after a worker or a
# machine is lost, and even twice at a time: each run makes its result under a name of its own, and the last one
# counts, which is the same to the bit. What a recording is and how it fails is as on one machine. Workers send one row
# a recording.

_OF_STORE = "://"  # in the address of an object store


@dataclass(frozen=True)
class Job:
    """The settings that all recordings of a batch share."""

    work: Work  # that can be pickled: a function of a module, or a partial of one
    results: str  # a folder that all workers share, or an address that fsspec knows, such as s3://bucket/run
    limits: Limits
    version: str  # of the splatnode that began the batch


def run_recording(recording: BatchRecording, job: Job) -> Outcome:
    """Runs it on a core of this machine that no other recording is on; the result is in `job.results` then.

    What fails is an outcome. Raises OSError where the results cannot be written.
    """
    if (other := other_version(job.version)) is not None:
        return make_failed_outcome(recording, NOT_RUN, other)
    if _OF_STORE not in job.results:
        return _run(recording, job, Path(job.results))
    with tempfile.TemporaryDirectory(prefix="splatnode-") as folder:
        found = _run(recording, job, Path(folder))
        _upload(Path(folder), recording, job.results)
        return found


def _run(recording: BatchRecording, job: Job, out: Path) -> Outcome:
    out.mkdir(parents=True, exist_ok=True)
    made_as = f"{recording.name}.{uuid.uuid4().hex[:12]}"
    try:
        with free_core() as core:
            child = Child.start(job.work(recording, partial_folder(out, made_as)), partial_log(out, made_as), (core,))
            end = wait_for_end(child, job.limits)
        return finalize_result(recording, out, made_as, end)
    finally:
        shutil.rmtree(partial_folder(out, made_as), ignore_errors=True)
        partial_log(out, made_as).unlink(missing_ok=True)


def _upload(folder: Path, recording: BatchRecording, results: str) -> None:
    """The report is the last file, so that a result that has one is whole."""
    import fsspec  # brought by torch; its own packages know the stores

    system, root = fsspec.core.url_to_fs(results)
    result = folder / recording.name
    files = sorted((path for path in result.rglob("*") if path.is_file()), key=lambda path: path == result / REPORT)
    if not files:
        system.makedirs(root, exist_ok=True)
        system.put_file(str(folder / f"{recording.name}.log"), f"{root}/{recording.name}.log")
    for path in files:
        target = f"{root}/{path.relative_to(folder).as_posix()}"
        system.makedirs(target.rpartition("/")[0], exist_ok=True)
        system.put_file(str(path), target)


def run_all_on_cluster(todo: Iterable[BatchRecording], job: Job, most: int | None) -> Generator[Outcome, None, None]:
    """The outcomes as they come, of at most `most` recordings at a time; None: of as many as the cluster has cores.

    A recording whose worker is lost is repeated elsewhere; after a few times it has failed. Raises ModuleNotFoundError
    without ray, which must have been joined.
    """
    from splatnode.extras.jobs import ray  # takes a second, and is an extra

    run = partial(run_recording, job=job)
    for recording, found in ray.map_on_cluster(partial(next, iter(todo), None), run, most, job.limits.memory_mb):
        yield make_failed_outcome(recording, NOT_RUN, found.reason) if isinstance(found, ray.LostCall) else found


def shortage(max_memory_mb: float | None) -> str | None:
    """Returns a message if no machine of the cluster has so much memory for a recording; None if one has.

    Ray, which must have been joined, would wait for such a machine without a word.
    """
    from splatnode.extras.jobs.ray import ray

    resources = (node["Resources"] for node in ray.nodes() if node["Alive"])
    most_mb = max((each.get("memory", 0.0) / 1e6 for each in resources if each.get("CPU")), default=0.0)
    if max_memory_mb is None or not most_mb or max_memory_mb <= most_mb:
        return None
    return (
        f"no machine of the cluster has the {max_memory_mb:g} MB that --max-memory sets aside for each recording, the "
        f"largest has {most_mb:.0f} MB: give less"
    )


def run_row(row: dict[str, Any], job: Job) -> dict[str, Any]:
    """A row of a dataset, which has name and source, with what came of it, column by column."""
    return {**row, **msgspec.structs.asdict(run_recording(BatchRecording(row["name"], row["source"]), job))}
