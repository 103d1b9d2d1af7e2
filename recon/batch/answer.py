"""What came of a recording: one row of the table, which the result's report.json and the end of its process give."""

from __future__ import annotations

import time
from pathlib import Path

import msgspec

from splatnode.capture.process.memory_shortage import SHORT_OF_MEMORY, outlast
from splatnode.capture.process.printable import sanitize_text
from splatnode.capture.process.records import record_in
from splatnode.recon.batch.sources import REPORT, BatchRecording
from splatnode.recon.jobs.child import End
from splatnode.recon.result.export.limits import read_json_file

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
