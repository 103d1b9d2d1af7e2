"""One trial: a case and a method, answered in a process of its own and compared with the truth where it is known."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import msgspec
import numpy as np

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.extras.evaluate.dataset import EvaluationScene, Split
from splatnode.extras.evaluate.protocol import PerceptualNetworks, Run, Settings, compare_cameras, evaluate
from splatnode.extras.evaluate.report import Timing, measure_timing
from splatnode.extras.evaluate.rivals.colmap import (
    Mapper,
    RegisteredFrame,
    map_globally,
    map_incrementally,
    reconstruct_sparse_model,
)
from splatnode.extras.evaluate.rivals.outcome import make_verdict
from splatnode.extras.evaluate.stability.case import (
    ROUGH,
    CameraError,
    Outcome,
    Probe,
    ProbeResult,
    TrialCase,
    classify_outcome,
    make_frames,
    score_cameras,
)
from splatnode.extras.evaluate.stability.perturbations import TrialImage
from splatnode.extras.jobs import calls
from splatnode.extras.jobs.calls import now
from splatnode.recon.clock import Clock
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.pipeline import estimate_frames, reconstruct, reconstruct_stream
from splatnode.recon.rasterize.dispatch import rasterize
from splatnode.recon.registration.registration import register
from splatnode.recon.result.report import peak_rss_mb
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.verification.evidence import verify

# What goes through the matrix: splatnode by its public entry point, and stock reconstructions beside it.

Method = Callable[[Iterable[Frame | DroppedFrame], ReconstructionConfig], Snapshot]

NAMES = ("splatnode", "colmap", "glomap")


def splatnode(frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig) -> Snapshot:
    """The last snapshot."""
    (last,) = deque(reconstruct(frames, config), maxlen=1)
    return last


def splatnode_stream(frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig) -> Snapshot:
    """The last snapshot of frames that come one at a time."""
    (last,) = deque(reconstruct_stream(frames, config), maxlen=1)
    return last


def find_method(name: str, stream: bool = False) -> Method:
    """The method; `stream`: for frames that come one at a time, if it can.

    Raises ValueError for a method that there is not, or that needs a package that is not installed.
    """
    if name == "splatnode":
        return splatnode_stream if stream else splatnode
    if name not in NAMES:
        raise ValueError(f"no method {name!r}; there are: {', '.join(NAMES)}")
    try:
        pass
    except ImportError as error:
        raise ValueError(f"method {name!r} needs pycolmap. Run: pip install 'splatnode[bench]'") from error
    return colmap if name == "colmap" else glomap


# What splatnode registered, published or not: whether a refusal was of right cameras.


def ensure_registration(estimate: Reconstruction, config: ReconstructionConfig) -> Reconstruction:
    """The estimate with the cameras and the evidence of a registration, also where the verdict needed none."""
    if estimate.registration is not None:
        return estimate
    registration = register(estimate.graph.keyframes, estimate.graph.pairs, config.registration)
    return replace(
        estimate, registration=registration, evidence=verify(estimate.graph, registration, config.verification)
    )


def list_registered_cameras(estimate: Reconstruction) -> tuple[CameraEstimate, ...]:
    """The registered cameras, for their frames at full size; those that were placed, where a scene may be published."""
    if estimate.registration is None:
        return ()
    bounds, found = estimate.bounds, []
    for camera in estimate.registration.cameras:
        frame = estimate.graph.keyframes[camera.index].frame
        K = np.diag([*camera.focals, 1.0])
        K[:2, 2] = camera.principal
        of_camera = (camera.T_world_camera, K, frame.width, frame.height, bounds.get(frame.name))
        found.append(CameraEstimate(frame.name, frame.frame_id, *of_camera))
    return tuple(
        each for each in found if not estimate.verdict.publishable or each.name in estimate.publishable_camera_names
    )


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


def judge_trial(case: TrialCase, row: int, name: str, seed: int, method: str, answer: calls.Answer) -> Trial:
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


# The cameras of stock COLMAP and GLOMAP (extras/evaluate/rivals/colmap.py) as a snapshot without Gaussians.


def colmap(frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig) -> Snapshot:
    """Incremental mapping."""
    return _reconstruct(frames, config, map_incrementally)


def glomap(frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig) -> Snapshot:
    """Global mapping."""
    return _reconstruct(frames, config, map_globally)


def _reconstruct(frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig, mapping: Mapper) -> Snapshot:
    usable = [frame for frame in frames if isinstance(frame, Frame)]
    model = reconstruct_sparse_model(usable, config.seed, mapping)
    registered = () if model is None else model.registered
    found = make_verdict(usable, {each.frame.name for each in registered})
    return Snapshot(
        sequence=1,
        verdict=found,
        cameras=tuple(map(make_camera_estimate, registered)) if found.publishable else (),
        gaussians=GaussianArrays.empty(),
        images={},
        dropped=(),
        iterations=0,
        final=True,
    )


def make_camera_estimate(registered: RegisteredFrame) -> CameraEstimate:
    """The camera of a registered frame, for the frame at full size; nothing is claimed of it."""
    frame = registered.frame
    return CameraEstimate(
        frame.name,
        frame.frame_id,
        registered.T_world_camera,
        registered.intrinsics.K,
        frame.width,
        frame.height,
    )


# What rows measure besides the verdict. A probe runs after the trial's own reconstruction, in the same process.

_MAX_OVERFIT_DB = 0.3  # PSNR that ten times the iterations may lose
_MAX_CHANGE = 0.2  # of the number of Gaussians, between a budget and ten times that budget
_MAX_LOSS_ONE_BY_ONE = 0.03  # share of the PSNR that may be lost when frames come one by one
_REPEATS = 2  # further runs that must give the same bits


def make_same_cameras_probe(photos: Sequence[TrialImage], *, rotation_deg: float, centre_pct: float) -> Probe:
    """The cameras of `photos` in this order are those of the trial, within the limits."""
    return partial(_measure_same_cameras, make_frames(photos), rotation_deg, centre_pct)


def _measure_same_cameras(
    others: Sequence[Frame], rotation_deg: float, centre_pct: float, snapshot: Snapshot, config: ReconstructionConfig
) -> ProbeResult:
    second = {camera.name: camera for camera in splatnode(list(others), config).cameras}
    pairs = [(camera, second[camera.name]) for camera in snapshot.cameras if camera.name in second]
    errors = compare_cameras(
        *(np.array([pair[i].T_world_camera for pair in pairs]).reshape(-1, 4, 4) for i in (0, 1)),
        *(np.array([pair[i].K for pair in pairs]).reshape(-1, 3, 3) for i in (0, 1)),
    )
    rotation, centre = errors.rotation_pair_deg, errors.centre_pct
    if rotation is None or centre is None:
        return ProbeResult({"common_cameras": len(pairs)}, held=False)
    values = {"common_cameras": len(pairs), "rotation_difference_deg": rotation, "centre_difference_pct": centre}
    everyone = len(pairs) == len(snapshot.cameras) == len(second)
    return ProbeResult(values, held=everyone and rotation < rotation_deg and centre < centre_pct)


def make_repeatability_probe(photos: Sequence[TrialImage]) -> Probe:
    """The same frames give the same scene again."""
    return partial(_measure_repeatability, make_frames(photos))


def _measure_repeatability(same: Sequence[Frame], snapshot: Snapshot, config: ReconstructionConfig) -> ProbeResult:
    largest = 0.0
    for _ in range(_REPEATS):
        again = splatnode(list(same), config)
        if len(again.gaussians) != len(snapshot.gaussians) or len(again.cameras) != len(snapshot.cameras):
            return ProbeResult({"num_gaussians": len(snapshot.gaussians), "again": len(again.gaussians)}, held=False)
        poses = [(a.T_world_camera, b.T_world_camera) for a, b in zip(again.cameras, snapshot.cameras, strict=True)]
        for ours, before in [*poses, (again.gaussians.means, snapshot.gaussians.means)]:
            largest = max(largest, float(np.abs(ours - before).max(initial=0.0)))
    return ProbeResult({"repeats": _REPEATS, "largest_difference": largest}, held=largest == 0.0)


def make_overfit_probe(photos: Sequence[TrialImage], scene: EvaluationScene, test: Sequence[str]) -> Probe:
    """Ten times the iterations do not show the unseen views worse."""
    return partial(_measure_overfit, make_frames(photos), scene, tuple(test))


def _measure_overfit(
    same: Sequence[Frame],
    scene: EvaluationScene,
    test: tuple[str, ...],
    snapshot: Snapshot,
    config: ReconstructionConfig,
) -> ProbeResult:
    longer = msgspec.structs.replace(config.optimize, iterations=10 * config.optimize.iterations)
    long = splatnode(list(same), msgspec.structs.replace(config, optimize=longer))
    before, after = (_measure_held_out_psnr(found, scene, test, config) for found in (snapshot, long))
    values = {"psnr": before, "psnr_ten_times_longer": after}
    return ProbeResult(values, held=after > before - _MAX_OVERFIT_DB)


def make_budget_probe(photos: Sequence[TrialImage]) -> Probe:
    """Ten times the Gaussians allowed does not mean more Gaussians."""
    return partial(_measure_bigger_budget, make_frames(photos))


def _measure_bigger_budget(same: Sequence[Frame], snapshot: Snapshot, config: ReconstructionConfig) -> ProbeResult:
    count = len(snapshot.gaussians)
    wide = splatnode(list(same), msgspec.structs.replace(config, max_gaussians=10 * count))
    values = {"num_gaussians": count, "with_ten_times_the_budget": len(wide.gaussians)}
    return ProbeResult(values, held=abs(len(wide.gaussians) - count) <= _MAX_CHANGE * count)


def make_stream_quality_probe(photos: Sequence[TrialImage], scene: EvaluationScene, test: Sequence[str]) -> Probe:
    """Frames that came one by one show the unseen views as well as if all had been there at once."""
    return partial(_measure_stream_quality, make_frames(photos), scene, tuple(test))


def _measure_stream_quality(
    same: Sequence[Frame],
    scene: EvaluationScene,
    test: tuple[str, ...],
    snapshot: Snapshot,
    config: ReconstructionConfig,
) -> ProbeResult:
    batch = splatnode(list(same), config)
    one_by_one, at_once = (_measure_held_out_psnr(found, scene, test, config) for found in (snapshot, batch))
    values = {"psnr_one_by_one": one_by_one, "psnr_at_once": at_once}
    return ProbeResult(values, held=one_by_one > (1.0 - _MAX_LOSS_ONE_BY_ONE) * at_once)


def _measure_held_out_psnr(
    snapshot: Snapshot, scene: EvaluationScene, test: tuple[str, ...], config: ReconstructionConfig
) -> float:
    """dB; 0 where nothing was published."""
    scored = evaluate(
        snapshot,
        scene,
        Split(tuple(camera.name for camera in snapshot.cameras), test),
        Run("splatnode", config.seed, None, {}, None),
        rasterize=rasterize,
        networks=PerceptualNetworks(alex=None, vgg=None),
        settings=Settings(longer_side=config.size, alignment_steps=60, alignment_levels=2),
    )
    return scored.psnr or 0.0
