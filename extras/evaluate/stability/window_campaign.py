"""All windows of a plan, some at a time; what is on the disk already is not run again."""

from __future__ import annotations

import argparse
import io
import itertools
import logging
import os
import pickle
import shlex
import sys
import time
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator, PercentFormatter

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.process.config import record_of
from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate.dataset import read_json
from splatnode.extras.evaluate.methods import make_verdict
from splatnode.extras.evaluate.report import (
    Timing,
    check_same_cores,
    describe_machine,
    explain_missing_seconds,
    measure_timing,
)
from splatnode.extras.evaluate.rivals import colmap
from splatnode.extras.evaluate.runner import Journal
from splatnode.extras.evaluate.stability.perturbations import TrialScene, load_trial_scenes
from splatnode.extras.evaluate.stability.trial import (
    NAMES,
    ensure_registration,
    find_method,
    list_registered_cameras,
    make_camera_estimate,
)
from splatnode.extras.evaluate.stability.windows import (
    COUNTS,
    OURS,
    PieceKey,
    Pieces,
    RowKey,
    Window,
    WindowAnswer,
    WindowOutcome,
    WindowRow,
    draw_windows,
    judge_window,
    load_plain_features,
    make_key,
    match_keyframes,
    select_keys,
    select_moving_scenes,
)
from splatnode.extras.jobs import Engine, Limits, Task, Work, now, pack_call, work_folder
from splatnode.extras.jobs import engine as opened
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction, estimate_cameras, load_prior, prepare
from splatnode.recon.fallbacks import run_fallbacks
from splatnode.recon.keyframes import screen_all
from splatnode.recon.matching.view_graph import mask_moving_objects, match
from splatnode.recon.result.export.staged import hold_result_folder, json_bytes, write_files

# splatnode's answers to windows: the steps of recon/pipeline.py up to the verdict.

LensSetting = Literal["nothing", "exif", "given"]  # what comes with the photographs of the lens
EXIF_ERROR = 0.03  # by which EXIF's focal length is off at most, of its logarithm


def reconstruct_window(
    place: TrialScene,
    window: Window,
    config: ReconstructionConfig,
    fresh: bool,
    lens_setting: LensSetting,
    known: Pieces,
) -> tuple[WindowAnswer, dict[PieceKey, bytes]]:
    """The answer, and what was found for it that is not `known` of the scene. It is called in a process of its own.

    `lens_setting`: what comes with the photographs, see `load_window_frames`; `fresh`: measures the seconds from
    photographs on, too.
    """
    matcher, frames = load_prior(config).matcher, load_window_frames(place, window, lens_setting)
    kept, _, rejected = screen_all(frames, config.screening)
    keyframes = [prepare(frame, config, load_plain_features(known, frame.name)) for frame in kept]
    graph, found = match_keyframes(keyframes, known, config.matching, matcher)
    graph = mask_moving_objects(graph, matcher)
    since, started = now(), time.perf_counter()
    estimate = run_fallbacks(estimate_cameras(graph, rejected, config), rejected, config)
    seconds, timed_on = time.perf_counter() - started, measure_timing(since)
    fresh_seconds, fresh_on = _time_fresh_run(frames, config) if fresh else (None, None)
    estimate = ensure_registration(estimate, config)
    cameras, evidence = list_registered_cameras(estimate), estimate.evidence_record
    return WindowAnswer(estimate.verdict, cameras, seconds, timed_on, fresh_seconds, fresh_on, evidence), found


def load_window_frames(place: TrialScene, window: Window, lens_setting: LensSetting = "nothing") -> list[Frame]:
    """The photographs without what masks hide; their ids are their positions in the scene.

    Nothing is known about the camera; or the true intrinsics are given; or EXIF tells the focal length alone, within
    3 %, by one factor for all photographs, as one camera errs.
    """
    frames = []
    generator = np.random.default_rng([window.start, window.stride, window.count, zlib.crc32(place.name.encode())])
    factor = float(np.exp(generator.uniform(-EXIF_ERROR, EXIF_ERROR)))
    for frame in place.scene.frames(window.names):
        index, intrinsics = place.names.index(frame.name), None
        if lens_setting != "nothing":
            intrinsics = place.scene.cameras[frame.name].intrinsics_for(frame.width, frame.height)
        if lens_setting == "exif" and intrinsics is not None:
            size, focal = (frame.width, frame.height), factor * intrinsics.fx
            intrinsics = Intrinsics(*size, focal, focal, size[0] / 2, size[1] / 2, "exif")
        frames.append(replace(frame, frame_id=index, stamp_ns=index, intrinsics=intrinsics))
    return frames


def estimate_without_store(frames: Sequence[Frame], config: ReconstructionConfig) -> Reconstruction:
    """Cameras and verdict of the frames, with nothing kept of other windows."""
    kept, _, rejected = screen_all(frames, config.screening)
    matcher = load_prior(config).matcher
    graph = mask_moving_objects(match([prepare(frame, config) for frame in kept], config.matching, matcher), matcher)
    return run_fallbacks(estimate_cameras(graph, rejected, config), rejected, config)


def _time_fresh_run(frames: Sequence[Frame], config: ReconstructionConfig) -> tuple[float, Timing]:
    since, started = now(), time.perf_counter()
    estimate_without_store(frames, config)
    return time.perf_counter() - started, measure_timing(since)


# Windows in turn, each with what was found in its scene by those that have ended before it is begun.


@dataclass(frozen=True, eq=False)
class Job:
    place: TrialScene
    window: Window
    method: str

    @property
    def key(self) -> RowKey:
        return make_key(self.window, self.method)


class WindowScheduler:
    """Windows of one scene come one after the other, as long as there are other scenes for whoever else is free.

    What was found lies in `folder` until the last window of its scene has ended.
    """

    def __init__(self, jobs: Sequence[Job], folder: Path) -> None:
        self._waiting = list(jobs)
        self._under_way: Counter[TrialScene] = Counter()
        self._folder, self._numbers = folder, itertools.count()
        self._found: dict[TrialScene, dict[PieceKey, Path]] = {}

    def take_job(self) -> tuple[Job, Pieces] | None:
        """The first window of a scene of which none is under way, else the first; None: all have begun."""
        if not self._waiting:
            return None
        idle = (job for job in self._waiting if not self._under_way[job.place])
        job = next(idle, self._waiting[0])
        self._waiting.remove(job)
        self._under_way[job.place] += 1
        found = self._found.get(job.place, {})
        return job, {key: found[key].read_bytes() for key in select_keys(found.keys(), job.window.names)}

    def finish_job(self, job: Job, found: Mapping[PieceKey, bytes]) -> None:
        """Stores what a window has found; nothing where it failed."""
        self._under_way[job.place] -= 1
        known = self._found.setdefault(job.place, {})
        if not self._under_way[job.place] and not any(other.place is job.place for other in self._waiting):
            for path in self._found.pop(job.place).values():
                path.unlink()
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        for key in found.keys() - known.keys():
            known[key] = self._folder / str(next(self._numbers))
            known[key].write_bytes(found[key])


# The rows counted: how often an answer is right, by angle and by count; and what the 95 % bounds are worth.

ANGLE_BINS = (
    ("below 8", 0.0, 8.0),
    ("8 to 15", 8.0, 15.0),
    ("15 to 25", 15.0, 25.0),
    ("25 to 40", 25.0, 40.0),
    ("above 40", 40.0, 360.0),
)  # degrees
KINDS = ("rotation", "centre", "focal")  # of errors that have a bound
PERCENTILES = (50, 90, 95, 99)


@dataclass(frozen=True)
class Tally:
    """Windows of one method, by what became of them; and whether the cameras were right that it had, published or not.

    A method that registers and then refuses (splatnode) has cameras for which `own_right` and
    `own_right_published` differ.
    """

    sets: int
    right: int  # published, right, all photographs placed
    right_part: int  # the same with photographs left out
    between: int  # published, neither right nor beyond the claim
    wrong: int  # published, beyond the claim
    refused: int
    failed: int
    own_right: int  # all cameras right, all photographs placed
    own_right_published: int
    own_right_part: int  # all cameras right, photographs left out
    own_right_part_published: int


@dataclass(frozen=True)
class Coverage:
    """How many published cameras, and of each kind of error: the share within its bound, and percentiles of the ratio.

    None where nothing was claimed.
    """

    cameras: int
    within: dict[str, float | None]
    ratio: dict[str, dict[str, float] | None]  # error over bound, by percentile


def summarise(rows: Sequence[WindowRow]) -> dict[str, Any]:
    """Returns what windows.json holds besides its rows, by method."""
    return {
        method: {
            "all": asdict(tally_rows(mine)),
            "by_angle": {name: asdict(tally_rows(some)) for name, some in group_by_angle(mine).items()},
            "by_count": {str(count): asdict(tally_rows(some)) for count, some in group_by_count(mine).items()},
            "coverage": {
                "all": asdict(measure_coverage(mine)),
                **{str(count): asdict(measure_coverage(some)) for count, some in group_by_count(mine).items()},
            },
        }
        for method, mine in group_by_method(rows).items()
    }


def group_by_method(rows: Sequence[WindowRow]) -> dict[str, list[WindowRow]]:
    return {name: [row for row in rows if row.method == name] for name in dict.fromkeys(row.method for row in rows)}


def group_by_angle(rows: Sequence[WindowRow]) -> dict[str, list[WindowRow]]:
    return {name: [row for row in rows if least <= row.angle_deg < most] for name, least, most in ANGLE_BINS}


def group_by_count(rows: Sequence[WindowRow]) -> dict[int, list[WindowRow]]:
    return {count: [row for row in rows if row.count == count] for count in sorted({row.count for row in rows})}


def tally_rows(rows: Iterable[WindowRow]) -> Tally:
    every = list(rows)
    found = [row.outcome for row in every]
    own, part = ([row for row in every if row.right and row.whole is whole] for whole in (True, False))
    return Tally(
        sets=len(every),
        **{kind.value: found.count(kind) for kind in WindowOutcome},
        own_right=len(own),
        own_right_published=sum(row.published for row in own),
        own_right_part=len(part),
        own_right_part_published=sum(row.published for row in part),
    )


def measure_coverage(rows: Iterable[WindowRow]) -> Coverage:
    """Measures the coverage of the bounds of the published cameras."""
    cameras = [camera for row in rows if row.published for camera in row.cameras]
    claimed = {kind: [c.pair_with_bounds()[kind] for c in cameras if kind in c.pair_with_bounds()] for kind in KINDS}
    return Coverage(
        cameras=len(cameras),
        within={kind: compute_share_within(pairs) for kind, pairs in claimed.items()},
        ratio={kind: _compute_percentiles(pairs) for kind, pairs in claimed.items()},
    )


def compute_share_within(pairs: Sequence[tuple[float, float]]) -> float | None:
    """The share of errors that are at most their bound."""
    return sum(error <= bound for error, bound in pairs) / len(pairs) if pairs else None


def _compute_percentiles(pairs: Sequence[tuple[float, float]]) -> dict[str, float] | None:
    if not pairs:
        return None
    ratios = [error / max(bound, 1e-9) for error, bound in pairs]
    return {
        str(percent): float(value)
        for percent, value in zip(PERCENTILES, np.percentile(ratios, PERCENTILES), strict=True)
    }


logger = logging.getLogger(__name__)

FILE = "windows.json"
_JOURNAL = "windows.jsonl"


@dataclass(frozen=True)
class Plan:
    methods: tuple[str, ...]
    per_kind: int = 2  # windows of each scene, count and stride, at most
    counts: tuple[int, ...] = COUNTS
    seed: int = 0  # of the draw of the windows
    lens_setting: LensSetting = "nothing"  # of the lens, to splatnode: see `load_window_frames`
    fresh: bool = False  # measures each window's seconds from photographs on, too
    timeout_s: float = 120.0  # of one method on one window, from the start of its process on
    max_memory_mb: float | None = None  # of the same
    config: ReconstructionConfig = field(default_factory=ReconstructionConfig)


def run_windows(plan: Plan, places: Sequence[TrialScene], out: Path, command: str, engine: Engine) -> list[WindowRow]:
    """Runs what is missing in `out`/windows.json and returns all its rows. Rows without an answer are run again.

    What came to an end is on the disk at once, in a journal beside the file, which is rewritten every few seconds. A
    window that fails, or exceeds its time or memory, becomes a row with the verdict "FAILED" and the reason. Seconds
    are those of windows that had their cores alone. Raises ValueError where the file is of windows with another number
    of cores, or where splatnode was told the lens of its windows and now is not, or the other way round.
    """
    rows = {row.key: row for row in _resume_rows(out, plan, engine.cores_each)}
    jobs = _list_jobs(plan, places)
    whole = partial(_write, out / FILE, plan, rows, [job.key for job in jobs], command)
    with hold_result_folder(out), work_folder(out) as folder:
        if not (out / FILE).exists():
            whole()  # whether the windows of the journal had their lens given
        with Journal(out / _JOURNAL, whole) as kept:
            rows |= {row.key: row for row in (record_of(record, WindowRow) for record in kept.recover_records())}
            todo = [job for job in jobs if job.key not in rows or not _is_done(rows[job.key], plan)]
            for number, row in enumerate(_run_jobs(plan, todo, engine, folder), start=len(jobs) - len(todo) + 1):
                rows[row.key] = row
                kept.add(asdict(row))
                logger.info(
                    f"windows {number}/{len(jobs)}: {row.scene}, {row.count} at stride {row.stride} from {row.start}, "
                    f"{row.method}: {row.verdict}, {row.outcome.value}"
                )
            if not todo:
                whole()  # it tells of this command, too
    return _order_rows(rows, [job.key for job in jobs])


def _list_jobs(plan: Plan, places: Sequence[TrialScene]) -> list[Job]:
    """Scene after scene; in a scene splatnode's windows come first."""
    found = []
    for place in select_moving_scenes(places):
        windows = draw_windows(place, plan.per_kind, plan.seed, plan.counts)
        asked = [Job(place, window, method) for window in windows for method in plan.methods]
        found += sorted(asked, key=lambda job: job.method != OURS)
    return found


def _is_done(row: WindowRow, plan: Plan) -> bool:
    return row.outcome is not WindowOutcome.FAILED and (row.fresh_seconds is not None or not plan.fresh)


def _run_jobs(plan: Plan, todo: Sequence[Job], engine: Engine, folder: Path) -> Iterator[WindowRow]:
    """Rows as they are done."""
    turns = WindowScheduler(todo, folder / "found")

    def take() -> Task | None:
        turn = turns.take_job()
        return turn and Task(turn[0], pack_call(_make_work(plan, *turn)))

    limits = Limits(plan.max_memory_mb, plan.timeout_s)
    for job, answer in engine.answers(take, limits, folder / "calls"):
        nothing = WindowAnswer(None, message=answer.reason), {}
        said, found = nothing if answer.pickled is None else answer.value()
        turns.finish_job(job, found)
        yield judge_window(job.window, job.method, said, job.place.scene.cameras)


def _make_work(plan: Plan, job: Job, known: Pieces) -> Work:
    if job.method == OURS:
        return partial(reconstruct_window, job.place, job.window, plan.config, plan.fresh, plan.lens_setting, known)

    return partial(run_rival_on_window, job.place, job.window, job.method, plan.config.seed, plan.fresh, known)


class _Rows(msgspec.Struct, frozen=True):
    rows: list[WindowRow]
    machine: dict[str, Any] = {}
    told: LensSetting = "nothing"


def read_rows(path: Path) -> list[WindowRow]:
    """The rows of a windows.json; none where there is no such file. Raises EvaluationFileError for another file."""
    return _read_content(path).rows


def _resume_rows(out: Path, plan: Plan, cores_each: int) -> list[WindowRow]:
    path = out / FILE
    content = _read_content(path)
    begun = content.rows or (path.exists() and (out / _JOURNAL).exists())
    if begun and content.told != plan.lens_setting:
        raise ValueError(f"{path} holds windows with --known-lens {content.told}: give another folder with --out DIR")
    before = content.machine.get("threads")  # which each window had, before a row said so itself
    known = [row.cores or before for row in content.rows if row.seconds is not None]
    check_same_cores([cores for cores in known if cores], cores_each, path)
    return content.rows


def _read_content(path: Path) -> _Rows:
    return read_json(path, _Rows, "the windows.json of this version") if path.exists() else _Rows([])


def _order_rows(rows: dict[RowKey, WindowRow], asked: Sequence[RowKey]) -> list[WindowRow]:
    """Those of the plan in its order, whichever came to its end first, after those of earlier plans."""
    planned = set(asked)
    return [*(rows[key] for key in rows if key not in planned), *(rows[key] for key in asked if key in rows)]


def _write(path: Path, plan: Plan, rows: dict[RowKey, WindowRow], asked: Sequence[RowKey], command: str) -> None:
    ordered = _order_rows(rows, asked)
    content = {
        "command": command,
        "machine": describe_machine(),
        "seed": plan.seed,
        "told": plan.lens_setting,
        "summary": summarise(ordered),
        "rows": [{**asdict(row), "right": row.right, "found": row.outcome.value} for row in ordered],
    }
    write_files(path.parent, {path.name: json_bytes(content)})


# COLMAP's and GLOMAP's answers to windows: a photograph's features and a pair's matches are found once in a scene.

_KIND = "colmap"  # of pieces: those of all mappers


def run_rival_on_window(
    place: TrialScene, window: Window, method: str, seed: int, fresh: bool, known: Pieces
) -> tuple[WindowAnswer, dict[PieceKey, bytes]]:
    """The answer, and what was found for it that is not `known` of the scene. It is called in a process of its own.

    `fresh`: measures the seconds from photographs on, too.
    """
    frames, mapper = load_window_frames(place, window), colmap.MAPPERS[method]
    with TemporaryDirectory(prefix="splatnode-window-") as name:
        folder = Path(name)
        named = colmap.name_images(frames)
        found = _match_images(folder, named, seed, known)
        since, started = now(), time.perf_counter()
        model = colmap.map_largest_model(folder, named, seed, mapper)
        seconds, timed_on = time.perf_counter() - started, measure_timing(since)
    fresh_seconds, fresh_on = _time_fresh_rival(frames, seed, mapper) if fresh else (None, None)
    registered = () if model is None else model.registered
    said = make_verdict(frames, {each.frame.name for each in registered})
    cameras = tuple(map(make_camera_estimate, registered))
    return WindowAnswer(said, cameras, seconds, timed_on, fresh_seconds, fresh_on), found


def _match_images(folder: Path, named: Mapping[str, Frame], seed: int, known: Pieces) -> dict[PieceKey, bytes]:
    """Makes the database of the images, which are `named`, in `folder`; returns what was found that is not known."""
    keys = {image: (_KIND, frame.name) for image, frame in named.items()}
    described = {image: pickle.loads(known[key]) for image, key in keys.items() if key in known}
    of_pair = {pair: (_KIND, *(named[image].name for image in pair)) for pair in itertools.combinations(named, 2)}
    matches = {pair: pickle.loads(known[key]) for pair, key in of_pair.items() if key in known}
    colmap.extract_features(folder, named, seed, described)
    colmap.match_pairs(folder, list(of_pair), seed, matches)
    found = {keys[image]: each for image, each in colmap.read_features(folder, set(named) - set(described)).items()}
    found |= {of_pair[pair]: each for pair, each in colmap.read_matches(folder, set(of_pair) - set(matches)).items()}
    return {key: pickle.dumps(piece) for key, piece in found.items()}


def _time_fresh_rival(frames: Sequence[Frame], seed: int, mapper: colmap.Mapper) -> tuple[float, Timing]:
    since, started = now(), time.perf_counter()
    colmap.reconstruct_sparse_model(frames, seed, mapper)
    return time.perf_counter() - started, measure_timing(since)


# Draws windows.json: `python -m splatnode.extras.evaluate.stability.window_campaign windows.json --out DIR`.
#
# Needs matplotlib (pip install 'splatnode[bench]').

_INK, _MUTED, _GRID = "#222222", "#6B6B6B", "#E4E4E4"
# Blue is right and vermilion is dangerous, as in the other charts: told apart with any colour vision.
_FOUND = {  # from the bottom of a bar to its top
    WindowOutcome.RIGHT: ("#2F7FB5", "published: right, all photographs placed"),
    WindowOutcome.RIGHT_PART: ("#9CC9E8", "published: right, some photographs left out"),
    WindowOutcome.BETWEEN: ("#F2D98B", "published: less exact, not wrong"),
    WindowOutcome.WRONG: ("#D55E00", "published: wrong"),
    WindowOutcome.REFUSED: ("#ECECEC", "no cameras published"),
    WindowOutcome.FAILED: ("#7F7F7F", "no answer"),
}
_COUNT_COLOURS = ("#CC79A7", "#0072B2", "#009E73", "#E69F00")
_NAMES = {
    "colmap": "COLMAP",
    "colmap-few-views": "COLMAP, options for few views",
    "glomap": "GLOMAP",
    "glomap-few-views": "GLOMAP, options for few views",
}
_CLAIMS = {"rotation": "rotation, degrees", "centre": "centre, % of the distance to the scene"}
_LEAST = 1e-3  # degrees or percent: what is smaller is drawn here
_WRONG_BELOW = (
    "Right: every camera within 2° and 5 % of the cameras' spread. Wrong: a camera beyond 2.5 times its 95 % bound, "
    "or, unless the\nverdict says rough, beyond 5° or 10 % of the distance to the scene; COLMAP and GLOMAP, which "
    "claim nothing: beyond 5° or 10 % of the spread."
)


def draw(rows: Sequence[WindowRow], out: Path) -> list[str]:
    """Writes the charts to `out` and returns their names; those that there is nothing to draw for are left out."""
    figures = {}
    if rows:
        figures["windows.png"] = make_shares_figure(rows)
    if any(camera.pair_with_bounds() for row in rows if row.published for camera in row.cameras):
        figures["calibration.png"] = make_bounds_figure(rows)
    for name, figure in figures.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", facecolor="white")
        write_files(out, {name: buffer.getvalue()})
    return list(figures)


def make_shares_figure(rows: Sequence[WindowRow]) -> Figure:
    """A panel a method: shares of what was published, by the angle between neighbouring views."""
    methods = group_by_method(rows)
    width, height = 1.0 + 3.6 * max(len(methods), 2), 4.6
    figure = Figure(figsize=(width, height), dpi=150)
    for number, (method, mine) in enumerate(methods.items()):
        share = (width - 1.0) / len(methods) / width
        axes = figure.add_axes((0.7 / width + number * share, 1.3 / height, share - 0.15 / width, 2.5 / height))
        _draw_shares(axes, method, mine, labelled=number == 0)
    title = "Windows of 3, 6 and 12 consecutive photographs, by the angle between neighbouring views"
    figure.text(0.1 / width, 1.0 - 0.3 / height, title, color=_INK, fontsize=11 if len(methods) > 2 else 8.5)
    there = {row.outcome for row in rows}
    handles = [Patch(color=colour, label=text) for found, (colour, text) in _FOUND.items() if found in there]
    figure.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(0.0, 0.42 / height), ncols=3, frameon=False, fontsize=7.5
    )
    figure.text(0.1 / width, 0.12 / height, _WRONG_BELOW, color=_MUTED, fontsize=6.8 if len(methods) > 2 else 4.8)
    return figure


def _draw_shares(axes: Axes, method: str, rows: Sequence[WindowRow], *, labelled: bool) -> None:
    bins = {name: some for name, some in group_by_angle(rows).items() if some}
    for x, some in enumerate(bins.values()):
        bottom = 0.0
        for found, (colour, _) in _FOUND.items():
            count = sum(row.outcome is found for row in some)
            share = count / len(some)
            axes.bar(x, share, 0.82, bottom=bottom, color=colour, edgecolor="white", linewidth=0.8)
            if count:
                ink = "white" if found in (WindowOutcome.RIGHT, WindowOutcome.WRONG, WindowOutcome.FAILED) else _INK
                axes.text(x, bottom + share / 2, str(count), ha="center", va="center", fontsize=6.5, color=ink)
            bottom += share
    axes.set_xticks(range(len(bins)), [f"{name}°\n{len(some)} sets" for name, some in bins.items()])
    axes.set_xlim(-0.55, len(bins) - 0.45)
    axes.set_ylim(0, 1)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.tick_params(length=0, labelsize=6.5, colors=_INK, labelleft=labelled)
    axes.spines[:].set_visible(False)
    right = sum(row.outcome in (WindowOutcome.RIGHT, WindowOutcome.RIGHT_PART) for row in rows)
    wrong = sum(row.outcome is WindowOutcome.WRONG for row in rows)
    name = _NAMES.get(method, method)
    axes.set_title(f"{name}\n{right} of {len(rows)} right, {wrong} wrong", loc="left", fontsize=9, color=_INK)
    if labelled:
        axes.set_ylabel("share of the sets", fontsize=7.5, color=_MUTED)


def make_bounds_figure(rows: Sequence[WindowRow]) -> Figure:
    """A panel a kind of error: what was found against what was claimed, a dot a published camera."""
    width, height = 9.6, 5.0
    figure = Figure(figsize=(width, height), dpi=150)
    for number, (kind, text) in enumerate(_CLAIMS.items()):
        axes = figure.add_axes(((0.75 + 4.75 * number) / width, 0.55 / height, 3.95 / width, 3.85 / height))
        _draw_bounds(axes, kind, text, group_by_count([row for row in rows if row.published]))
    title = "What the 95 % bounds are worth: the error of each published camera against its bound"
    figure.text(0.1 / width, 1.0 - 0.3 / height, title, color=_INK, fontsize=11)
    return figure


def _draw_bounds(axes: Axes, kind: str, text: str, rows: dict[int, list[WindowRow]]) -> None:
    everything: list[tuple[float, float]] = []
    for (count, some), colour in zip(rows.items(), _COUNT_COLOURS * len(rows), strict=False):
        pairs = [
            camera.pair_with_bounds()[kind]
            for row in some
            for camera in row.cameras
            if kind in camera.pair_with_bounds()
        ]
        share = compute_share_within(pairs)
        if share is None:
            continue
        error, bound = np.maximum(np.array(pairs).T, _LEAST)
        label = f"{count} views: {share:.0%} of {len(pairs)} cameras within"
        axes.scatter(bound, error, 9, color=colour, alpha=0.55, linewidths=0, label=label, zorder=2)
        everything += pairs
    values = np.maximum(np.array(everything).ravel(), _LEAST) if everything else np.array([_LEAST, 1.0])
    low, high = 10.0 ** np.floor(np.log10(values.min())), 10.0 ** np.ceil(np.log10(values.max() * 1.01))
    line = np.array([low, high])
    axes.fill_between(line, line, high, color="#FBEDE4", zorder=0)
    axes.plot(line, line, color=_INK, linewidth=1.0, zorder=1)
    axes.plot(line, 2.5 * line, color="#D55E00", linewidth=1.0, linestyle="--", zorder=1)
    axes.text(
        low * 1.3, high / 1.3, "beyond the bound;\nabove the dashed line: wrong", va="top", fontsize=7, color=_MUTED
    )
    axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())
    axes.set_xlabel(f"95 % bound: {text}", fontsize=7.5, color=_INK)
    axes.set_ylabel(f"error: {text}", fontsize=7.5, color=_INK)
    axes.tick_params(labelsize=7, colors=_INK)
    axes.grid(color=_GRID, linewidth=0.6, zorder=0)
    axes.spines[:].set_visible(False)
    axes.legend(loc="lower right", fontsize=7, frameon=True, framealpha=0.9, edgecolor="none", markerscale=1.6)


def main() -> None:
    parser = argparse.ArgumentParser(description="Draws the charts of the windows from their windows.json.")
    parser.add_argument("windows_json", type=Path)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    arguments = parser.parse_args()
    draw(read_rows(arguments.windows_json), arguments.out)


if __name__ == "__main__":
    main()


# `splatnode robustness --windows`.


def run_windows_verb(args: argparse.Namespace) -> int:
    """Runs the windows, writes windows.json and its charts, and prints the tables."""
    methods = args.methods or NAMES
    for method in methods:
        find_method(method)
    plan = Plan(
        methods,
        per_kind=args.windows_per_kind,
        counts=args.counts,
        lens_setting=args.known_lens,
        fresh=args.no_cache,
        timeout_s=args.timeout_s,
        max_memory_mb=args.max_memory,
    )
    command = shlex.join(["splatnode", *sys.argv[1:]])
    scenes, out = [Path(os.path.abspath(scene)) for scene in args.scenes], Path(os.path.abspath(args.out))
    with opened(args.cores, args.ray) as engine:  # other machines see the scenes, too, not this process's folder
        rows = run_windows(plan, load_trial_scenes(scenes, out), args.out, command, engine)
    drawn = _draw_charts(args.out, rows)
    print_report(rows)
    say(f"results: {args.out}/ ({', '.join((FILE, *drawn))})")
    return 0


def print_report(rows: Sequence[WindowRow]) -> None:
    """The tables, the windows without an answer with the reason, and of how many there are no seconds."""
    for line in format_report(rows):
        say(line)
    for row in rows:
        if row.outcome is WindowOutcome.FAILED:
            window = f"{row.scene}, {row.count} at stride {row.stride} from {row.start}, {row.method}"
            say(f"no answer: {window}: {row.message.strip().splitlines()[-1]}")
    if why := explain_missing_seconds([row.others for row in rows]):
        say(why)


def format_report(rows: Sequence[WindowRow]) -> list[str]:
    """For people: the windows of each method by angle and by count, then the shares within the 95 % bounds."""
    head = f"{'':>26} {'sets':>5} {'right':>6} {'part':>5} {'between':>8} {'wrong':>6} {'refused':>8} {'no answer':>10}"
    lines = [head + f" {'own right':>10} {'published':>10}"]
    for method, mine in group_by_method(rows).items():
        groups = {
            "all": mine,
            **{f"{name} degrees": some for name, some in group_by_angle(mine).items()},
            **{f"{count} views": some for count, some in group_by_count(mine).items()},
        }
        for name, some in groups.items():
            t = tally_rows(some)
            own = t.own_right + t.own_right_part, t.own_right_published + t.own_right_part_published
            lines.append(
                f"{method:>10} {name:>15} {t.sets:>5} {t.right:>6} {t.right_part:>5} {t.between:>8} {t.wrong:>6} "
                f"{t.refused:>8} {t.failed:>10} {own[0]:>10} {own[1]:>10}"
            )
    for count, some in group_by_count([row for row in rows if row.method == OURS]).items():
        found = measure_coverage(some)
        shares = [f"{kind} {found.within[kind]:.0%}" for kind in KINDS if found.within[kind] is not None]
        if shares:
            lines.append(f"within the 95 % bounds, {count} views ({found.cameras} cameras): {', '.join(shares)}")
    return lines


def _draw_charts(out: Path, rows: Sequence[WindowRow]) -> list[str]:
    """The names of the charts that were drawn to `out`."""
    return draw(rows, out)
