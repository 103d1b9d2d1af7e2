"""The verb batch, and what it leaves for people and for the recordings' own formats."""

from __future__ import annotations

import argparse
import base64
import contextlib
import csv
import html
import json
import os
import shutil
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import msgspec
import numpy as np

from splatnode.capture import film
from splatnode.capture.cameras.folder import image_paths
from splatnode.capture.image_file import UnusableImage, read_image_file
from splatnode.capture.process import python
from splatnode.capture.process.files import LOCK, LockHeld, exclusive, sync_folder
from splatnode.capture.process.library_lines import catch_library_lines
from splatnode.capture.process.system import remedy
from splatnode.capture.process.terminal import (
    ProgressStep,
    Tell,
    clear_progress,
    format_times,
    is_interactive,
    say,
    show_progress,
    show_waiting,
)
from splatnode.capture.process.text import cell, escape_text, sanitize_text
from splatnode.extras import lerobot
from splatnode.extras.batch import (
    FAILED,
    LEDGER,
    OWN_SUFFIX,
    BatchRecording,
    Job,
    Ledger,
    Outcome,
    Plan,
    Work,
    recordings,
    remove_leftovers,
    run_all,
    run_all_on_cluster,
    shortage,
)
from splatnode.extras.cameras.mcap import SUFFIX as MCAP
from splatnode.extras.jobs import Limits, chosen_cores, own_version
from splatnode.extras.logged.mcap import topics
from splatnode.extras.logged.messages import read_times
from splatnode.extras.verbs import replay_options
from splatnode.extras.viewers.mcap import Message, make_calibration, make_pose, make_time
from splatnode.recon.result.export import read_cameras
from splatnode.recon.result.export.staged import hold_result_folder
from splatnode.recon.result.snapshot import CameraEstimate, format_rounded_up

# index.html has counts by verdict, and a row with a picture for each recording; it needs no other file to be shown.
# The cameras lie beside the data sets and logs that they are of, in the formats of these: of a LeRobot data set in one
# table, meta/splatnode_cameras.parquet, with a row for each camera of each episode, or in columns of the same names in
# its own tables; of an MCAP file in another one beside it, NAME.splatnode.mcap, or in topics of its own.

# A small picture of each recording, for the page: its result's preview, or a photograph where there is no scene.

PREVIEW = "preview.png"
_WIDTH, _QUALITY = 320, 70  # pixels, of JPEG


def make_data_url(result: Path, source: Path) -> str | None:
    """A `data:` address of a JPEG; None where there is nothing to show."""
    path = result / PREVIEW
    if not path.is_file():
        photographs = image_paths(source) if source.is_dir() else []
        if not photographs:
            return None
        path = photographs[len(photographs) // 2]
    try:
        data = read_image_file(path)
    except (UnusableImage, OSError):
        return None
    with catch_library_lines():
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_REDUCED_COLOR_2)
    return None if image is None else _encode_preview(image)


def _encode_preview(image: np.ndarray) -> str:
    height, width = image.shape[:2]
    size = min(_WIDTH, width), max(1, round(height * min(_WIDTH, width) / width))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()


# batch.csv, and batch.parquet where pyarrow is installed: a row for each recording, written row by row.

CSV, PARQUET = "batch.csv", "batch.parquet"
COLUMNS = Outcome.__struct_fields__
BEING_WRITTEN = ".partial"  # the end of the hidden name under which a file is written; a killed process leaves it


def write_csv(path: Path, rows: Iterable[Outcome]) -> None:
    """Writes rows; the unknown is empty, text is what a spreadsheet takes for text. Raises OSError."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            writer.writerow(map(cell, msgspec.structs.astuple(escape_source(row))))


def write_parquet(path: Path, rows: Iterable[Outcome]) -> None:
    """Raises ModuleNotFoundError without pyarrow, OSError."""
    from splatnode.extras.batch import pyarrow as batch_pyarrow  # takes half a second, and is an extra

    with replacing(path) as temporary:
        batch_pyarrow.write(temporary, map(escape_source, rows))


def escape_source(row: Outcome) -> Outcome:
    """Returns the row with its source as text: bytes of a file's name that are no UTF-8 become escapes."""
    return msgspec.structs.replace(row, source=escape_text(row.source))


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A new file that takes the place of `path` at the end, and is on the disk then; else it is removed."""
    temporary = path.with_name(f".{path.name}{BEING_WRITTEN}")
    temporary.unlink(missing_ok=True)
    try:
        temporary.touch(exist_ok=False)  # what the name led to, if it was a link, stays as it is
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


PAGE = "index.html"
_MOST_PICTURES = 2000  # of about 10 kB; the recordings after them are shown without
_HEADS = (
    "",
    "recording",
    "verdict",
    "directions to",
    "positions to",
    "photographs",
    "Gaussians",
    "seconds",
    "MB of memory",
)
_STYLE = (
    "body{font:15px/1.45 sans-serif;margin:2em auto;max-width:1500px;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;margin:1em 0}td,th{border-bottom:1px solid #ddd;padding:.3em .7em;"
    "text-align:right;vertical-align:top}td.text,th.text{text-align:left}td.text{max-width:32em;overflow-wrap:anywhere}"
    "img{display:block;width:240px}small{color:#666}tr:target{background:#fffbe0}"
)


def write_page(path: Path, rows: Iterable[Outcome], verdicts: Mapping[str, int]) -> None:
    """`rows` in the order of `verdicts`, which counts them; their results lie beside `path`. Raises OSError."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(_lines(rows, verdicts, path.parent))


def _lines(rows: Iterable[Outcome], verdicts: Mapping[str, int], folder: Path) -> Iterator[str]:
    yield f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>Batch</title><style>{_STYLE}</style>'
    yield f"</head><body><h1>{sum(verdicts.values())} recordings</h1>\n<table><tr>"
    yield '<th class="text">verdict</th><th>recordings</th></tr>\n'
    for code, count in verdicts.items():
        yield f'<tr><td class="text"><a href="#{_text(code)}">{_text(code)}</a></td><td>{count}</td></tr>\n'
    yield "</table>\n<p>Each claim holds for 95 % of all cameras: directions in degrees, positions in percent of the "
    yield "distance to the scene. Seconds are of one core, from the start of the process to its end.</p>\n<table><tr>"
    yield "".join(f"<th{_format_class(head)}>{head}</th>" for head in _HEADS) + "</tr>\n"
    last = None
    for number, row in enumerate(rows):
        picture = make_data_url(folder / row.name, Path(row.source)) if number < _MOST_PICTURES else None
        yield _row(row, picture, begins=row.verdict != last)
        last = row.verdict
    yield "</table></body></html>\n"


def _row(row: Outcome, picture: str | None, begins: bool) -> str:
    target = f"{row.name}.log" if row.has_failed else f"{row.name}/"
    image = f'<img src="{picture}" alt="" loading="lazy">' if picture else ""
    link = f'<a href="./{_path(target)}">{_text(row.name)}</a>'
    cells = [
        f"<td>{image}</td>",
        f'<td class="text">{link}<br><small>{_text(row.source)}</small></td>',
        f'<td class="text"><b>{_text(row.verdict)}</b><br>{_text(row.message)}</td>',
        _cell(None if row.rotation_deg is None else f"{format_rounded_up(row.rotation_deg)}°"),
        _cell(None if row.centre_percent is None else f"{format_rounded_up(row.centre_percent)} %"),
        _cell(_format_count(row.photographs, row.left_out)),
        _cell(row.gaussians),
        _cell(f"{row.seconds:.1f}"),
        _cell(f"{row.memory_mb:.0f}"),
    ]
    mark = f' id="{_text(row.verdict)}"' if begins else ""
    return f"<tr{mark}>{''.join(cells)}</tr>\n"


def _format_count(placed: int | None, left_out: int | None) -> str | None:
    if placed is None:
        return None
    return f"{placed} of {placed + left_out}" if left_out else str(placed)


def _format_class(head: str) -> str:
    return ' class="text"' if head in ("recording", "verdict") else ""


def _cell(value: object) -> str:
    return f"<td>{'' if value is None else value}</td>"


def _text(raw: str) -> str:
    """Escapes untrusted text for the page: no markup, and no character that does more than show."""
    return html.escape(escape_text(raw))


def _path(name: str) -> str:
    """A file's name as an address relative to the page; no byte of it is markup, a scheme or a question."""
    return quote(os.fsencode(name))


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
    """One process at a time writes a log or a data set; what a killed one left is removed. Raises LockHeld, OSError."""
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

    info = lerobot.read_info(folder)
    numbered = [(*lerobot.episode_and_camera(folder, info, part), row) for part, row in parts]
    numbered.sort(key=lambda each: each[:2])
    seen = ((episode, key, _make_camera_row(row, out, info.fps)) for episode, key, row in numbered)
    if in_place:
        by_key: defaultdict[str, dict[int, Mapping[str, Any]]] = defaultdict(dict)
        for episode, key, values in seen:
            by_key[key][episode] = values
        files = sorted((folder / lerobot.EPISODES).glob("*/*.parquet"))
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

    messages: list[Message] = []
    schemas: dict[str, str] = {}
    for topic, row in parts:
        names = {kind: f"{topic}/splatnode/{kind}" for kind in ("pose", "calibration", "verdict")}
        schemas |= {names["pose"]: "PoseInFrame", names["calibration"]: "CameraCalibration", names["verdict"]: "Log"}
        messages += _make_topic_messages(file, topic, row, out, names)
    messages.sort(key=lambda each: each[1])
    target = file if in_place else file.with_name(file.stem + OWN_SUFFIX)
    with replacing(target) as temporary:
        if target.exists():
            mcap.write_with_messages(target, temporary, messages, schemas)
            shutil.copymode(target, temporary)
        else:
            temporary.write_bytes(mcap.encode_messages(messages, schemas))
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


Run = Callable[[Sequence[BatchRecording]], Iterator[Outcome]]  # the outcomes as they come

EXIT_GOOD, EXIT_SOME_FAILED = 0, 65
_OWN_NAMES = frozenset((LEDGER, CSV, PARQUET, PAGE))


def batch(args: argparse.Namespace) -> int:
    """Reconstructs every recording of the sources; EXIT_GOOD where each has an answer, be it that there is no scene."""
    with show_waiting("looking for recordings"):
        found = recordings(args.sources, args.out, _OWN_NAMES)
    options = replay_options(args)
    if args.in_place and not args.write_back:
        raise ValueError("--in-place says how --write-back writes; give both")
    if args.results and args.ray is None:
        raise ValueError("--results says where the workers of a cluster write; give --ray, too")
    if args.results and args.write_back:
        raise ValueError("--write-back reads the results in --out; leave --results out")
    return run_batch(args, found, partial(replay, tuple(options)), ["splatnode", "replay", *options])


def replay(options: Sequence[str], recording: BatchRecording, folder: Path) -> Sequence[str]:
    """The command that reconstructs a recording, on whatever machine this is called."""
    return python.command("splatnode", "replay", recording.source, "--out", str(folder), *options)


def run_batch(args: argparse.Namespace, found: list[BatchRecording], work: Work, ledger_command: list[str]) -> int:
    """Runs `work` for the recordings that have not come to an end, then writes the tables of all.

    `args` has out, resume, retry, cores, max_memory, timeout_s, write_back, in_place, ray, results and json;
    `ledger_command` is what the ledger says of it.
    Raises ValueError, OtherBatch, OSError.
    """
    running = _run_locally(args, work) if args.ray is None else _run_on_ray(args, work)
    with hold_result_folder(args.out):
        _check_new(args.out, args.resume or args.retry)
        with Ledger(args.out, ledger_command) as ledger, running as run, show_progress(quiet=args.json) as tell:
            run_again = {None, FAILED} if args.retry else {None}
            todo = [recording for recording in found if ledger.verdict(recording) in run_again]
            if len(todo) < len(found):
                tell(f"{len(found) - len(todo)} of {len(found)} recordings came to an end before")
            for line in _run(todo, run, ledger, tell):
                if not args.json:
                    clear_progress()
                    say(line)
            tell(ProgressStep("writing the tables"))
            counts = _write_tables(args.out, found, ledger, tell)
            all_written = not args.write_back or _write_back(args, ledger.rows(found), tell)
    if args.json:
        print(json.dumps({"recordings": len(found), "verdicts": counts}))
    else:
        say("; ".join(f"{code}: {count}" for code, count in counts.items()))
        say(f"results: {args.out}/ ({PAGE}, {CSV}, {LEDGER}, a folder for each recording)")
    return EXIT_SOME_FAILED if counts.get(FAILED) or not all_written else EXIT_GOOD


@contextlib.contextmanager
def _run_locally(args: argparse.Namespace, work: Work) -> Iterator[Run]:
    plan = Plan(args.out, chosen_cores(args.cores), Limits(args.max_memory, args.timeout_s))
    yield lambda todo: run_all(todo, work, plan)


@contextlib.contextmanager
def _run_on_ray(args: argparse.Namespace, work: Work) -> Iterator[Run]:
    """Raises NoCluster; ValueError where a Ray of this machine has too little memory; ModuleNotFoundError."""
    from splatnode.extras.jobs import ray  # takes a second, and is an extra

    results = args.results or str(args.out.resolve())
    job = Job(work, results, Limits(args.max_memory, args.timeout_s), own_version())
    try:
        with ray.join_cluster(args.ray, None if args.ray else len(chosen_cores(args.cores))):
            remove_leftovers(args.out)
            if (why := shortage(args.max_memory)) is not None and not args.ray:
                raise ValueError(why)
            if why is not None and not args.json:
                say(f"{why}, or recordings wait until one that has joins", error=True)
            yield lambda todo: run_all_on_cluster(todo, job, args.cores)
    finally:
        remove_leftovers(args.out)


def _run(todo: Sequence[BatchRecording], run: Run, ledger: Ledger, tell: Tell) -> Iterator[str]:
    """A line for each recording that has come to its end and has been written down."""
    doing, began_s = "reconstructing", time.monotonic()
    if todo:
        tell(ProgressStep(doing, 0, len(todo), "recording"))
    for done, found in enumerate(run(todo), start=1):
        ledger.append(found)
        step = ProgressStep(doing, done, len(todo), "recording")
        left = "" if is_interactive() else f"{done} of {len(todo)} ({format_times(step, time.monotonic() - began_s)}): "
        yield f"{left}{found.name}: {found.verdict}, {found.seconds:.1f} s{f': {found.message}' * found.has_failed}"
        tell(step)


def _write_back(args: argparse.Namespace, rows: Iterator[Outcome], tell: Tell) -> bool:
    """Whether the cameras lie in or beside all data sets and logs that they are of."""
    tell(ProgressStep("writing the cameras back"))
    written = list(write_back(rows, args.out, args.in_place))
    for each in written:
        tell(each.sentence)
    if not written:
        tell("nothing to write back to: no recording is of a data set or an MCAP file")
    return not any(each.failed for each in written)


def _write_tables(out: Path, found: Sequence[BatchRecording], ledger: Ledger, tell: Tell) -> dict[str, int]:
    """How many recordings have which verdict, the most frequent first; the tables are in the order of these."""
    verdicts = {recording: verdict for recording in found if (verdict := ledger.verdict(recording)) is not None}
    counts = dict(sorted(Counter(verdicts.values()).items(), key=lambda each: (-each[1], each[0])))
    places = {code: place for place, code in enumerate(counts)}
    ended = sorted(verdicts, key=lambda recording: (places[verdicts[recording]], recording.name))
    write_csv(out / CSV, ledger.rows(ended))
    try:
        write_parquet(out / PARQUET, ledger.rows(ended))
    except ModuleNotFoundError as error:
        (out / PARQUET).unlink(missing_ok=True)  # an earlier one, which is not of these recordings
        tell(f"no {PARQUET}: {error.name} is not installed. {remedy(error.name or '')}")
    write_page(out / PAGE, ledger.rows(ended), counts)
    return counts


def _check_new(out: Path, goes_on: bool) -> None:
    """Raises ValueError where `out` holds anything, unless it is a batch that goes on."""
    if (out / LEDGER).exists():
        if not goes_on:
            raise ValueError(f"{out} holds a batch already; --resume goes on with it, or give another --out")
    elif strangers := sorted(path.name for path in out.iterdir() if path.name != LOCK):
        raise ValueError(
            f"--out must be a new or an empty folder, {out} holds {sanitize_text(strangers[0])}; give another"
        )
