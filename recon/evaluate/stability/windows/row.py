"""One window and one method: the answer, compared with the truth."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from splatnode.recon.evaluate.stability.claim import (
    ROUGH,
    CameraError,
    has_only_right_cameras,
    measure_camera_errors,
    measure_set_errors,
)
from splatnode.recon.evaluate.stability.windows.window import Window
from splatnode.recon.evaluate.timing import Timing, find_largest_share, had_alone
from splatnode.recon.evaluate.truth import TrueCamera
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.verdict import Verdict

OURS = "splatnode"  # among the methods
FAILED = "FAILED"
Key = tuple[str, int, int, int, str]


class WindowOutcome(enum.Enum):
    """The outcome of a window, by what was published: right is within 2 degrees and 5 % of the spread."""

    RIGHT = "right"  # all photographs are placed
    RIGHT_PART = "right_part"  # those that are placed
    BETWEEN = "between"  # not right, and within the claim; without one, within 5 degrees and 10 %
    WRONG = "wrong"  # a camera is beyond its claim: see claim.CameraError.wrong
    REFUSED = "refused"
    FAILED = "failed"  # no answer


@dataclass(frozen=True)
class WindowAnswer:
    """The answer of a method to a window."""

    verdict: Verdict | None  # None: there was no answer, `message` says why
    cameras: tuple[CameraEstimate, ...] = ()  # where nothing is published, those that were registered all the same
    seconds: float | None = None
    timed_on: Timing | None = None  # of `seconds`
    fresh_seconds: float | None = None
    fresh_on: Timing | None = None
    evidence: Mapping[str, object] | None = None
    message: str = ""


@dataclass(frozen=True, kw_only=True)
class WindowRow:
    """One line of windows.json. What was not measured is None."""

    scene: str
    count: int
    stride: int
    start: int
    names: tuple[str, ...]
    angle_deg: float  # the largest over the views of the angle to the nearest other one: see window.angle_deg
    method: str
    verdict: str  # a code; FAILED where there was no answer
    published: bool
    message: str
    seconds: float | None  # from matched pairs to the verdict, or to the model; None also: not alone
    fresh_seconds: float | None  # from photographs to the same, with nothing kept of other windows
    cameras: tuple[CameraError, ...]  # those published; of a refusal, those that were registered
    rotation_deg: float | None  # the largest error of any relative rotation
    centre_pct: float | None  # RMS error of the centres, in percent of the true ones' spread
    evidence: Mapping[str, Any] | None  # recon.verification.likelihood.record
    cores: int | None = None  # that it could use
    processor: str | None = None
    others: float | None = None  # the share of the cores' time that others took meanwhile; None also: nobody can tell

    @property
    def key(self) -> Key:
        return self.scene, self.count, self.stride, self.start, self.method

    @property
    def right(self) -> bool:
        """Whether all cameras are right that there are, published or not."""
        return has_only_right_cameras(self.cameras)

    @property
    def whole(self) -> bool:
        """Whether every photograph has a camera."""
        return len(self.cameras) == self.count

    @property
    def outcome(self) -> WindowOutcome:
        if self.verdict == FAILED:
            return WindowOutcome.FAILED
        if not self.published:
            return WindowOutcome.REFUSED
        if not self.cameras or any(camera.is_wrong(self.verdict == ROUGH) for camera in self.cameras):
            return WindowOutcome.WRONG
        if self.right:
            return WindowOutcome.RIGHT if self.whole else WindowOutcome.RIGHT_PART
        return WindowOutcome.BETWEEN


def make_key(window: Window, method: str) -> Key:
    return window.scene, window.count, window.stride, window.start, method


def judge_window(window: Window, method: str, answer: WindowAnswer, truth: Mapping[str, TrueCamera]) -> WindowRow:
    """The answer against the true cameras of all photographs of the window."""
    whole = measure_set_errors(answer.cameras, truth)
    verdict, timed_on = answer.verdict, answer.timed_on
    others = find_largest_share((timed_on, answer.fresh_on))
    alone = had_alone(others)
    return WindowRow(
        scene=window.scene,
        count=window.count,
        stride=window.stride,
        start=window.start,
        names=window.names,
        angle_deg=window.angle_deg,
        method=method,
        verdict=FAILED if verdict is None else verdict.code.value,
        published=verdict is not None and verdict.publishable,
        message=answer.message if verdict is None else verdict.message,
        seconds=answer.seconds if alone else None,
        fresh_seconds=answer.fresh_seconds if alone else None,
        cameras=measure_camera_errors(answer.cameras, truth),
        rotation_deg=whole.rotation_pair_deg,
        centre_pct=whole.centre_pct,
        evidence=answer.evidence,
        cores=timed_on and timed_on.cores,
        processor=timed_on and timed_on.processor,
        others=others,
    )
