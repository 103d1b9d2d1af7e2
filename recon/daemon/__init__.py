"""The reconstruction as a daemon: keyframes in, scenes out; no keyframe that it acknowledged is lost. Its heartbeat."""

from __future__ import annotations

import contextlib
import enum
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import msgspec
import numpy as np

from splatnode.capture.messaging.messages import Amount, Count, Header, Name, Sequential, Text
from splatnode.capture.process.terminal import ProgressStep, RemainingTime
from splatnode.capture.process.text import sanitize_text
from splatnode.recon.result.message import CameraRecord
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.verdict import find_widest

# Which poses still hold: a scene's world changes where it is made afresh, and what was told in it is withdrawn then.
#
# A scene that grows keeps its world: its first camera stays where it is, and the others within their bounds.

MOST_WORLDS = 32  # scenes that a heartbeat tells of: those that changed last
UNBOUNDED_DEG, UNBOUNDED_SHARE = 0.5, 0.01  # by which a camera without bounds may move
REBUILT = "the scene was made afresh from all its keyframes"


class WorldRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The world of a scene. A pose in it holds as long as `revision` is the one that it was told with."""

    scene_id: Name
    revision: Sequential  # counts all changes of all worlds of this session
    provisional: bool  # it may still change
    why: Text  # it is not the one before; empty where there was none


Worlds = Annotated[tuple[WorldRecord, ...], msgspec.Meta(max_length=MOST_WORLDS)]


@dataclass(frozen=True, eq=False)
class _World:
    record: WorldRecord
    final: bool
    cameras: tuple[CameraEstimate, ...]


class WorldRevisions:
    """Numbers the worlds of all scenes. Any thread may ask and tell."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._worlds: dict[str, _World] = {}  # what changed last comes last
        self._changes = 0

    @property
    def records(self) -> tuple[WorldRecord, ...]:
        """The worlds that changed last, the newest last."""
        with self._lock:
            return tuple(world.record for world in self._worlds.values())

    def update(self, scene_id: str, snapshot: Snapshot) -> WorldRecord:
        """Notes what is shown of a scene, and tells its world."""
        provisional = not snapshot.final or snapshot.verdict.provisional
        with self._lock:
            before = self._worlds.get(scene_id)
            why = "" if before is None else _explain_change(before, snapshot)
            if before is None or why:
                return self._change(scene_id, why, provisional, snapshot.final, snapshot.cameras)
            record = msgspec.structs.replace(before.record, provisional=provisional)
            self._worlds[scene_id] = replace(before, record=record, final=snapshot.final, cameras=snapshot.cameras)
            return record

    def rebuild(self, scene_id: str, cameras: Sequence[CameraEstimate] = (), why: str = REBUILT) -> None:
        """Notes that a scene that the camera left has another world now, which is final."""
        with self._lock:
            if scene_id in self._worlds:
                self._change(scene_id, why, not cameras, bool(cameras), tuple(cameras))

    def _change(
        self, scene_id: str, why: str, provisional: bool, final: bool, cameras: tuple[CameraEstimate, ...]
    ) -> WorldRecord:
        self._changes += 1
        record = WorldRecord(scene_id, self._changes, provisional, why)
        self._worlds.pop(scene_id, None)
        self._worlds[scene_id] = _World(record, final, cameras)
        while len(self._worlds) > MOST_WORLDS:
            del self._worlds[next(iter(self._worlds))]
        return record


def _explain_change(before: _World, now: Snapshot) -> str:
    """Says why poses that were told before do not hold in what is shown now; empty where they do."""
    if now.final and (not before.final or now.cameras != before.cameras):
        return REBUILT
    if before.cameras and not now.cameras:
        return f"there is no scene any more: {now.verdict.code.value}"
    return explain_moved_cameras(before.cameras, now.cameras)


def explain_moved_cameras(before: Sequence[CameraEstimate], now: Sequence[CameraEstimate]) -> str:
    """Says which camera is gone, or moved by more than its bounds before; empty where all hold."""
    placed = {camera.name: camera.T_world_camera for camera in now}
    widest = find_widest(camera.bounds for camera in before if camera.bounds is not None)
    size = float(np.ptp([camera.T_world_camera[:3, 3] for camera in before], axis=0).max()) if before else 0.0
    turn_deg = UNBOUNDED_DEG if widest is None else widest.rotation_deg
    shift = UNBOUNDED_SHARE * size if widest is None else widest.centre
    for camera in before:
        if camera.name not in placed:
            return f"the camera of {camera.name} was removed"
        T = np.linalg.inv(camera.T_world_camera) @ placed[camera.name]
        cosine = np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)
        if float(np.degrees(np.arccos(cosine))) > turn_deg or float(np.linalg.norm(T[:3, 3])) > shift:
            return f"the camera of {camera.name} moved by more than its bounds"
    return ""


# The heartbeat of the recon daemon.


class ReconState(enum.Enum):
    LOADING = "loading"  # what an earlier process knew, after a start
    WAITING = "waiting"  # until there are keyframes enough for a scene
    GROWING = "growing"  # adds keyframes to the scene
    REFINING = "refining"  # no keyframe is waiting: the scene is built anew from all of them and optimised
    IDLE = "idle"  # the scene is finished
    LOST = "lost"  # the last keyframes do not belong to the scene
    FULL = "full"  # keyframes cannot be stored; they wait with the sender


PLACES = 8  # that a heartbeat tells of; places.json has all


class SubmapStatus(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A submap, as it was when it was last worked on."""

    scene_id: Name
    state: Name  # here, left, finished
    verdict: Text
    keyframes: Count  # with a camera in its scene
    left_out: Count  # keyframes without one
    seconds: Amount  # that were worked on it
    rss_mb: Amount  # memory of the process then


class WorkProgress(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The work under way, how far it is, and how long the rest of it takes."""

    doing: Text  # in words
    done: Sequential  # things that were counted so far
    of: Sequential  # 0: there is nothing to count
    what: Text  # one of the things: "step", "keyframe", "scene"
    left_s: Amount | None = None  # by what was measured in this process; None: nothing tells it


class ReconStatus(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    state: ReconState
    uptime_s: Amount
    scene_id: Name
    keyframe: Count  # number of the last one that was taken, -1 before
    queue: Count  # keyframes that are stored and not in the scene yet
    keyframes: Count  # that the scene is made of
    num_gaussians: Count
    iterations: Count
    final: bool
    verdict: Text
    message: Text
    bounds: Text  # the widest of the scene's cameras, in words; empty where there are none
    keyframe_s: Amount | None  # from the last keyframe's arrival until the scene showed it
    delay_s: Amount  # that the oldest keyframe has waited which no scene shows yet; 0: none waits
    delay: Text  # what it waits for
    unfinished: Count  # inactive submaps whose scenes are not final yet
    scenes: Count  # whose cameras are verified with all evidence, of all submaps
    maps: Count  # that these are, joined by the chains and loops that count
    loops: Count
    newest_places: Annotated[tuple[SubmapStatus, ...], msgspec.Meta(max_length=PLACES)]
    refused: Count  # malformed messages
    duplicates: Count  # keyframes that came again
    rss_mb: Amount
    camera_moved: bool | None  # None: not watched
    moved: Text  # by how much and with what certainty; empty while it stands still
    tracked: CameraRecord | None  # where the live camera is in the finished scene, if that is known
    worlds: Worlds = ()  # of the scenes, as poses in them are told: another revision withdraws those before
    work: WorkProgress | None = None  # None: nothing is being done, or the node is older
    problem: Text  # what keeps the node from working as it should; empty where nothing does


# What the node works on, how far it is, and how long the rest takes by what was measured in this process.
#
# Nothing is told before there is a basis: a step that was never finished here, and does not count, has no end in sight.

REMEMBERED = 8  # pieces of each kind of work, of whose rates the median counts
# Seconds of a final scene grow with its views as these two (tests/bench/results/rates.json); the machine scales both.
FINAL_BASE_S, FINAL_S_A_VIEW = 4.5, 0.87


class Work(enum.Enum):
    """A kind of work; the value is what people read."""

    KEYFRAMES = "working in keyframes"
    FINAL = "making the scene final"
    JUDGE = "judging scenes that the camera left"
    FINISH = "making scenes final that the camera left"


@dataclass(frozen=True)
class Backlog:
    """The work that waits, beside what is being done."""

    keyframes: int = 0  # that no scene shows yet, those that are being worked in among them
    unjudged: int = 0  # inactive submaps that are not verified, the one in work among them
    unfinished: int = 0  # of which no scene is final yet, these and others that are judged


@dataclass
class _Piece:
    work: Work
    size: float
    began_s: float
    step: tuple[ProgressStep, float] | None = None  # the newest, with what was left of it then, and when it came
    remaining: RemainingTime = field(default_factory=RemainingTime)
    nested_s: float = 0.0  # that other work took within it


def weigh_final(views: int) -> float:
    """How much work a final scene of so many views is, relative to others."""
    return FINAL_BASE_S + FINAL_S_A_VIEW * views


class WorkMeter:
    """Measures pieces of work. One thread works and calls `measure`, `tell`; any thread may `describe`."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._pieces: tuple[_Piece, ...] = ()  # the innermost comes last
        self._rates: dict[Work, deque[float]] = {work: deque(maxlen=REMEMBERED) for work in Work}
        self._done = dict.fromkeys(Work, 0)  # keyframes, scenes

    @contextlib.contextmanager
    def measure(self, work: Work, size: float = 1.0, count: int = 1) -> Iterator[None]:
        """Measures what is done within; what ends by an exception is not measured.

        `size` is how much it is, relative to others of its kind, and `count` how many things it does.
        """
        piece = _Piece(work, size, self._clock())
        self._pieces = (*self._pieces, piece)
        try:
            yield
            self._done[work] += count
            if size > 0:
                self._rates[work].append((self._clock() - piece.began_s - piece.nested_s) / size)
        finally:
            self._pieces = self._pieces[:-1]
            for outer in self._pieces[-1:]:
                outer.nested_s += self._clock() - piece.began_s

    def tell(self, told: ProgressStep | str) -> None:
        """Notes how far the innermost piece of work is; lines of text are for people who wait at a terminal."""
        if self._pieces and isinstance(told, ProgressStep):
            piece, now_s = self._pieces[-1], self._clock()
            piece.step = replace(told, left_s=piece.remaining.estimate(told, now_s)), now_s

    def restart_count(self, work: Work) -> None:
        """Counts what is done of this kind from now on."""
        self._done[work] = 0

    def predict_s(self, work: Work, size: float = 1.0) -> float | None:
        """Seconds that a piece of this size takes, as others took here; None where none was finished yet."""
        rates = list(self._rates[work])
        return statistics.median(rates) * size if rates else None

    def describe(self, backlog: Backlog) -> WorkProgress | None:
        """Tells what is being done, and the seconds until all of its kind is; None while nothing is."""
        pieces = self._pieces
        if not pieces:
            return None
        piece, now_s = pieces[-1], self._clock()
        step = self._find_step(piece, backlog)
        left_s = self._find_left(piece, backlog, now_s)
        return WorkProgress(sanitize_text(step.doing), step.done, step.of, sanitize_text(step.what), left_s)

    def _find_step(self, piece: _Piece, backlog: Backlog) -> ProgressStep:
        done = self._done[piece.work]
        if piece.work is Work.KEYFRAMES:
            return ProgressStep(piece.work.value, done, done + backlog.keyframes, "keyframe")
        if piece.work is Work.FINAL:
            return piece.step[0] if piece.step else ProgressStep(piece.work.value)
        waiting = backlog.unjudged if piece.work is Work.JUDGE else backlog.unfinished
        return ProgressStep(piece.work.value, done, done + waiting, "scene")

    def _find_left(self, piece: _Piece, backlog: Backlog, now_s: float) -> float | None:
        spent_s = now_s - piece.began_s - piece.nested_s
        if piece.work is Work.FINAL and piece.step is not None and piece.step[0].of:
            step, told_s = piece.step
            return None if step.left_s is None else max(0.0, step.left_s - (now_s - told_s))
        if piece.work is Work.FINAL:
            return _subtract(self.predict_s(piece.work, piece.size), spent_s)
        if piece.work is Work.KEYFRAMES:
            return _subtract(self.predict_s(piece.work, backlog.keyframes), spent_s)
        judging, finishing = (
            self.predict_s(Work.JUDGE, backlog.unjudged),
            self.predict_s(Work.FINISH, backlog.unfinished),
        )
        if finishing is None or (judging is None and backlog.unjudged):
            return None
        return _subtract(finishing + (judging or 0.0), spent_s)


def _subtract(whole_s: float | None, spent_s: float) -> float | None:
    """Returns what is left of a prediction; None where there is none, or more than that is spent already."""
    return None if whole_s is None or spent_s >= whole_s else whole_s - spent_s
