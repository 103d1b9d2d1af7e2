"""One trial: a case and a method in a process of its own, so that a crash, a hang or its memory are its own."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from multiprocessing.context import ForkServerContext

from splatnode.recon.clock import Clock
from splatnode.recon.evaluate.process import call_alone
from splatnode.recon.evaluate.stability.case import Case, Measured
from splatnode.recon.evaluate.stability.claim import ROUGH, CameraError
from splatnode.recon.evaluate.stability.methods import by_name
from splatnode.recon.evaluate.stability.outcome import Outcome, compare, outcome
from splatnode.recon.evaluate.stability.own_cameras import cameras_of, registered
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
    seconds: float | None = None  # wall time from the first frame to the last snapshot
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
class Answer:
    """What the other process leaves."""

    verdict: Verdict
    cameras: tuple[CameraEstimate, ...]  # those published; of splatnode's refusals, those that were registered
    evidence: Mapping[str, object] | None
    num_gaussians: int
    seconds: float
    processor_seconds: float
    peak_rss_mb: float | None
    measured: Measured | None


def run_trial(case: Case, row: int, name: str, seed: int, method: str, timeout_s: float) -> Trial:
    answer = _answer(case, method, timeout_s)
    head = {
        "row": row,
        "name": name,
        "seed": seed,
        "method": method,
        "note": case.note,
        "demand": case.demand.value,
        "expected": tuple(sorted(code.value for code in case.codes)),
    }
    if isinstance(answer, str):
        failed = Outcome.FAILED
        return Trial(**head, verdict=FAILED, published=False, right=failed.right, outcome=failed.value, message=answer)
    verdict = answer.verdict
    score = compare(answer.cameras, case.worlds, rough=verdict.code.value == ROUGH)
    found = outcome(case.demand, verdict.publishable, score.right, verdict.code in case.codes)
    return Trial(
        **head,
        verdict=verdict.code.value,
        published=verdict.publishable,
        right=found.right,
        outcome=found.value,
        seconds=answer.seconds,
        processor_seconds=answer.processor_seconds,
        peak_rss_mb=answer.peak_rss_mb,
        num_cameras=len(answer.cameras) if verdict.publishable else 0,
        num_gaussians=answer.num_gaussians,
        rotation_error_deg=score.rotation_error_deg if verdict.publishable else None,
        centre_error_pct=score.centre_error_pct if verdict.publishable else None,
        measured=answer.measured.values if answer.measured else None,
        held=answer.measured.held if answer.measured else None,
        errors=score.errors,
        registered_right=score.exact if answer.cameras else None,
        evidence=answer.evidence,
        message=verdict.message,
    )


def _answer(case: Case, method: str, timeout_s: float) -> Answer | str:
    """The answer, or why there is none."""
    job = dataclasses.replace(case, worlds=())  # the truth stays here
    try:
        return call_alone(partial(_work, job, method), timeout_s, _context())
    except RuntimeError as error:
        return str(error)


def _context() -> ForkServerContext:
    """Processes that find everything imported: half of a short trial would be the import of torch."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return context


def _work(case: Case, method: str) -> Answer:
    """The other process, in a session of its own: who interrupts a campaign must not make a trial fail."""
    os.setsid()
    reconstruct = by_name(method, case.stream)
    started, worked = time.perf_counter(), time.process_time()
    snapshot = reconstruct(case.source(), case.config)
    seconds, processor_seconds = time.perf_counter() - started, time.process_time() - worked
    peak = peak_rss_mb()
    probe = case.probe if snapshot.verdict.publishable and method == "splatnode" else None
    cameras, evidence = snapshot.cameras, snapshot.evidence
    if method == "splatnode" and not snapshot.verdict.publishable:
        estimate = registered(estimate_frames(case.source(), case.config, Clock())[0], case.config)
        cameras, evidence = cameras_of(estimate), estimate.evidence_record
    return Answer(
        verdict=snapshot.verdict,
        cameras=cameras,
        evidence=evidence,
        num_gaussians=len(snapshot.gaussians),
        seconds=seconds,
        processor_seconds=processor_seconds,
        peak_rss_mb=peak,
        measured=probe(snapshot, case.config) if probe is not None else None,
    )
