"""One trial: a case and a method, answered in a process of its own and compared with the truth where it is known."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

from splatnode.recon.clock import Clock
from splatnode.recon.evaluate.stability.case import ProbeResult, TrialCase
from splatnode.recon.evaluate.stability.claim import ROUGH, CameraError
from splatnode.recon.evaluate.stability.methods import find_method
from splatnode.recon.evaluate.stability.outcome import Outcome, classify_outcome, score_cameras
from splatnode.recon.evaluate.stability.own_cameras import ensure_registration, list_registered_cameras
from splatnode.recon.evaluate.timing import Timing, measure_timing
from splatnode.recon.jobs import call
from splatnode.recon.jobs.alone import now
from splatnode.recon.pipeline import estimate_frames
from splatnode.recon.result.report import peak_rss_mb
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.verdict import Verdict

FAILED = "FAILED"


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One line of stability.json. What was not measured is None."""

    row: int
    name: str
    seed: int
    method: str
    note: str
    demand: str  # accept, refuse or either
    expected: tuple[str, ...]  # codes that describe the frames
    verdict: str  # a code; FAILED where there was no answer
    published: bool
    right: bool  # the answer as a whole: see outcome.Outcome
    outcome: str
    seconds: float | None = None  # wall time from the first frame to the last snapshot; None also: not alone
    cores: int | None = None  # that it could use
    processor: str | None = None
    others: float | None = None  # the share of the cores' time that others took meanwhile; None also: nobody can tell
    processor_seconds: float | None = None
    peak_rss_mb: float | None = None
    num_cameras: int = 0  # that were published
    num_gaussians: int | None = None
    rotation_error_deg: float | None = None
    centre_error_pct: float | None = None
    measured: Mapping[str, float] | None = None  # by the row's probe
    held: bool | None = None  # whether that was within the row's limits
    errors: tuple[CameraError, ...] = ()  # of the published cameras; of a refusal, of those that were registered
    registered_right: bool | None = None  # whether the registered cameras are right, published or not; None: no cameras
    evidence: Mapping[str, object] | None = None  # recon.verification.likelihood.record
    message: str = ""  # the verdict's sentence, or the error


@dataclass(frozen=True, eq=False)
class TrialResult:
    """The result that the other process returns."""

    verdict: Verdict
    cameras: tuple[CameraEstimate, ...]  # those published; of splatnode's refusals, those that were registered
    evidence: Mapping[str, object] | None
    num_gaussians: int
    seconds: float
    timed_on: Timing
    processor_seconds: float
    peak_rss_mb: float | None
    measured: ProbeResult | None


def judge_trial(case: TrialCase, row: int, name: str, seed: int, method: str, answer: call.Answer) -> Trial:
    """The trial of a case that `run_trial` was called for; its photographs are not looked at."""
    head = {
        "row": row,
        "name": name,
        "seed": seed,
        "method": method,
        "note": case.note,
        "demand": case.demand.value,
        "expected": tuple(sorted(code.value for code in case.codes)),
    }
    if answer.pickled is None:
        failed, why = Outcome.FAILED, answer.reason
        return Trial(**head, verdict=FAILED, published=False, right=failed.right, outcome=failed.value, message=why)
    made: TrialResult = answer.value()
    verdict = made.verdict
    score = score_cameras(made.cameras, case.worlds, rough=verdict.code.value == ROUGH)
    found = classify_outcome(case.demand, verdict.publishable, score.right, verdict.code in case.codes)
    return Trial(
        **head,
        verdict=verdict.code.value,
        published=verdict.publishable,
        right=found.right,
        outcome=found.value,
        seconds=made.seconds if made.timed_on.is_alone else None,
        cores=made.timed_on.cores,
        processor=made.timed_on.processor,
        others=made.timed_on.others,
        processor_seconds=made.processor_seconds,
        peak_rss_mb=made.peak_rss_mb,
        num_cameras=len(made.cameras) if verdict.publishable else 0,
        num_gaussians=made.num_gaussians,
        rotation_error_deg=score.rotation_error_deg if verdict.publishable else None,
        centre_error_pct=score.centre_error_pct if verdict.publishable else None,
        measured=made.measured.values if made.measured else None,
        held=made.measured.held if made.measured else None,
        errors=score.errors,
        registered_right=score.exact if made.cameras else None,
        evidence=made.evidence,
        message=verdict.message,
    )


def run_trial(case: TrialCase, method: str) -> TrialResult:
    """Runs a method on the images of `case`, without the truth, in a process of its own."""
    reconstruct = find_method(method, case.stream)
    since, started, worked = now(), time.perf_counter(), time.process_time()
    snapshot = reconstruct(case.source(), case.config)
    seconds, processor_seconds = time.perf_counter() - started, time.process_time() - worked
    timed_on, peak = measure_timing(since), peak_rss_mb()
    probe = case.probe if snapshot.verdict.publishable and method == "splatnode" else None
    cameras, evidence = snapshot.cameras, snapshot.evidence
    if method == "splatnode" and not snapshot.verdict.publishable:
        estimate = ensure_registration(estimate_frames(case.source(), case.config, Clock())[0], case.config)
        cameras, evidence = list_registered_cameras(estimate), estimate.evidence_record
    return TrialResult(
        verdict=snapshot.verdict,
        cameras=cameras,
        evidence=evidence,
        num_gaussians=len(snapshot.gaussians),
        seconds=seconds,
        timed_on=timed_on,
        processor_seconds=processor_seconds,
        peak_rss_mb=peak,
        measured=probe(snapshot, case.config) if probe is not None else None,
    )
