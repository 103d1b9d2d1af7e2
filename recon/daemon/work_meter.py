"""What the node works on, how far it is, and how long the rest takes by what was measured in this process.

Nothing is told before there is a basis: a step that was never finished here, and does not count, has no end in sight.
"""

from __future__ import annotations

import contextlib
import enum
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

from splatnode.capture.process.terminal import ProgressStep, RemainingTime
from splatnode.capture.process.text import sanitize_text
from splatnode.recon.daemon.status import WorkProgress

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
    unjudged: int = 0  # places that were left, the one that is being judged among them
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
