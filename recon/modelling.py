"""From an estimate to what is shown: the scene begins, is refined and watched meanwhile, and becomes snapshots."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt
import torch

from splatnode.capture.frame import DroppedFrame
from splatnode.capture.masks import fill_masked
from splatnode.capture.rig import form_frame_sets
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.core import give_back_memory
from splatnode.recon.estimation import Reconstruction, ReconstructionSummary, View
from splatnode.recon.geometry import align_cameras
from splatnode.recon.keyframes import valid_masks
from splatnode.recon.optimize import training
from splatnode.recon.optimize.training import examine, single_torch_thread, start_watch
from splatnode.recon.priors import Pointmap, compute_consistent_depths
from splatnode.recon.rasterize import choose_device
from splatnode.recon.registration.registration import undistort_keyframes
from splatnode.recon.result.export.formats.ply import compute_ply_bytes
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, InGivenWorld, OnRig, Snapshot
from splatnode.recon.result.stored_snapshot import append_consistent_depth
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.scene import Scene, growth, transients
from splatnode.recon.scene import exposure as scene_exposure
from splatnode.recon.scene.exposure import compute_exposure_priors
from splatnode.recon.scene.initialization import create_coarse_scene, initialize_scene

# Budgets: which of the limits that were asked for bound a scene, and what more would buy.

STAYS = 0.5  # of the Gaussians that a scene begins with, after pruning without a limit: mean of 4 scenes of 6 views
# What held-out views lacked, in dB of PSNR, where there was less: means of the 2 scenes of `tests.bench budgets`.
FEWER = ((0.0, 0.0), (1.0, 0.0), (2.0, 0.6), (3.0, 1.3), (4.0, 2.0))  # by how often the Gaussians were halved
EARLIER = ((0.0, 6.1), (0.05, 1.9), (0.1, 1.0), (0.2, 0.5), (0.4, 0.2), (1.0, 0.0))  # by the share of the iterations
# From so many dB of PSNR on that new views lack, how a scene looks beside the one without a limit.
_WORSE = ((0.0, "hardly worse"), (0.1, "a little worse"), (0.5, "noticeably worse"), (2.0, "much worse"))
WINDOW = 0.2  # of the iterations, at the end, from which the slope of the loss is told


@dataclass(frozen=True)
class BudgetHit:
    """A limit that bound the scene."""

    limit: str  # its name in the configuration
    given: float
    would_take: float  # in the same unit: what the scene would have taken by itself, an estimate
    gain_db: float  # by which new views would then be better, as they were in scenes that were measured
    basis: str  # what the estimate rests on
    at_least: bool = False  # it would take more than `would_take`

    def record(self) -> dict[str, object]:
        """For report.json."""
        code = Code.BUDGET_HIT.value
        unit = {"max_gaussians": "Gaussians", "max_mb": "MB", "budget_s": "s"}[self.limit]
        worse = next(words for least, words in reversed(_WORSE) if self.gain_db >= least)
        about = "more than" if self.at_least else "about"
        message = (
            f"{code}: {self.limit} of {self.given:g} {unit} made the scene {worse} than without this limit; "
            f"{about} {self.would_take:.7g} {unit} would suffice"
        )
        return {"code": code, **asdict(self), "message": message}


def find_budget_hits(
    config: ReconstructionConfig,
    begun: Scene | None,
    scene: Scene | None,
    seconds: Mapping[str, float],
    ended_early: bool = False,
) -> tuple[BudgetHit, ...]:
    """The limits of `config` that bound `scene`, if there is one, which was refined from `begun` in these seconds.

    `ended_early`: the refinement came to its end by a verdict, and not for want of time.
    """
    if begun is None or scene is None:
        return ()
    found = (_gaussians(config, begun, scene), None if ended_early else _seconds(config, begun, scene, seconds))
    return tuple(hit for hit in found if hit is not None)


def _gaussians(config: ReconstructionConfig, begun: Scene, scene: Scene) -> BudgetHit | None:
    most, count = config.most_gaussians, len(scene.gaussians)
    if most is None or begun.num_unlimited <= most:
        return None
    if count < most and begun.num_unlimited <= (config.first_gaussians or most):  # it began with all, and fewer stayed
        return None
    share = 1.0 if config.optimize.control is None else STAYS
    would_take = max(round(share * begun.num_unlimited), count)
    gain = _gain(float(np.log2(would_take / count)), FEWER)
    basis = f"{begun.num_unlimited} pieces of equal colour and depth, of which {share:.0%} stay as a rule"
    if most == config.max_gaussians:
        return BudgetHit("max_gaussians", most, would_take, gain, basis)
    assert config.max_mb is not None  # it is the only other limit
    return BudgetHit("max_mb", config.max_mb, round(compute_ply_bytes(would_take, 1) / 1e6, 2), gain, basis)


def _seconds(
    config: ReconstructionConfig, begun: Scene, scene: Scene, seconds: Mapping[str, float]
) -> BudgetHit | None:
    done, planned = scene.iterations - begun.iterations, config.optimize.steps
    if config.budget_s is None or done >= planned:
        return None
    gain = _gain(done / planned, EARLIER)
    if not done:
        stages = {
            "cameras": seconds.get("poses", 0.0) + seconds.get("fallbacks", 0.0),
            "points": seconds.get("points", 0.0),
        }
        taken = ", ".join(f"{name} {spent:.1f} s" for name, spent in stages.items())
        beyond = seconds["total"] - config.budget_s
        basis = f"the least took {beyond:.1f} s too long ({taken}), nothing was refined, and refining takes time on top"
        return BudgetHit("budget_s", config.budget_s, round(seconds["total"], 1), gain, basis, at_least=True)
    each = seconds.get("optimise", 0.0) / done
    would_take = round(seconds["total"] + each * (planned - done), 1)
    fall = loss_fall(scene.losses) / each
    return BudgetHit(
        "budget_s",
        config.budget_s,
        would_take,
        gain,
        f"{done} of {planned} iterations were made; the loss fell by {fall:.1%} a second at the end",
    )


def _gain(less: float, lacked: Sequence[tuple[float, float]]) -> float:
    """dB, between the measured ones."""
    measured, missing = np.array(lacked).T
    return round(float(np.interp(less, measured, missing)), 1)


def loss_fall(losses: Sequence[float]) -> float:
    """The part of itself by which the loss falls an iteration, at the end; 0 where too few are known."""
    half = round(WINDOW * len(losses)) // 2
    if not half:
        return 0.0
    before, after = sum(losses[-2 * half : -half]), sum(losses[-half:])
    return max(0.0, 1.0 - after / before) / half


# From an estimate to what is shown: the scene begins, is refined and watched meanwhile, and becomes snapshots.

COARSE = "Coarse so far: the matched points alone; depth and refinement follow."

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

_PROCESSOR = torch.device("cpu")


@dataclass(frozen=True, eq=False)
class SceneWithVerdict:
    """A scene as others may see it, and the verdict on its refinement where that replaces the one on the cameras."""

    scene: Scene | None = None
    verdict: Verdict | None = None  # DIVERGED, without a scene, or OVERFIT, with the best one before


def prepare_scene_for_display(scene: Scene | None, config: ReconstructionConfig) -> SceneWithVerdict:
    """The scene with as many Gaussians as there may be."""
    return SceneWithVerdict(None if scene is None else growth.limit_gaussians(scene, config.most_gaussians))


@single_torch_thread()
def create_coarse_preview(estimate: Reconstruction, config: ReconstructionConfig) -> SceneWithVerdict | None:
    """A coarse scene as soon as there are cameras, with a verdict that says so; None where no scene is published."""
    if estimate.registration is None or not estimate.verdict.publishable:
        return None
    scene = create_coarse_scene(*undistort_keyframes(estimate.graph, estimate.registration), config.most_gaussians)
    return SceneWithVerdict(scene, replace(estimate.verdict, message=f"{estimate.verdict.message} {COARSE}"))


@single_torch_thread()
def create_initial_scene(
    estimate: Reconstruction, config: ReconstructionConfig, all_at_hand: bool = True
) -> Scene | None:
    """The scene of all cameras that were placed, not optimised yet; None where the verdict forbids one.

    Photographs that were exposed differently are brought to one light first. Of photographs that are all at hand, what
    verified views see through is left out.
    """
    if estimate.registration is None or not estimate.verdict.publishable:
        return None
    pointmaps = tuple(estimate.pointmaps.values())
    keyframes = undistort_keyframes(estimate.graph, estimate.registration)[0].keyframes
    images = {keyframe.name: keyframe.image for keyframe in keyframes}
    masks = {keyframe.name: keyframe.mask for keyframe in keyframes}
    lenses = {keyframe.name: keyframe.lens for keyframe in keyframes}
    metadata_exposures = compute_exposure_priors(
        keyframe for keyframe in keyframes if keyframe.name in estimate.pointmaps
    )
    exposures, headroom = scene_exposure.apply_headroom(
        images, scene_exposure.estimate_exposures(pointmaps, images, config.exposure_compensation, metadata_exposures)
    )
    images = scene_exposure.compensate_images(images, exposures)
    seen_through = _find_transient_masks(pointmaps, images, masks, config) if all_at_hand else {}
    for name, hidden in seen_through.items():
        free, own = ~hidden, masks[name]
        masks[name] = free if own is None else free & own
        images[name] = fill_masked(images[name], free)
    scene = initialize_scene(pointmaps, images, config.scene_initialization, masks, exposures, lenses)
    shares = {name: float(hidden.mean()) for name, hidden in seen_through.items()}
    views = tuple(replace(view, moved=shares.get(view.name, 0.0)) for view in scene.views)
    return replace(scene, views=views, headroom=headroom)


def _find_transient_masks(
    pointmaps: Sequence[Pointmap],
    images: Mapping[str, Image],
    masks: Mapping[str, Mask | None],
    config: ReconstructionConfig,
) -> dict[str, Mask]:
    """For each photograph that shows what others see through: the mask (h, w), True there, that no other mask hides."""
    if not config.transient_mask.enabled:
        return {}
    pictures = [images[pointmap.name] for pointmap in pointmaps]
    used = []
    for pointmap, rim in zip(pointmaps, valid_masks(pictures), strict=True):
        mask = masks[pointmap.name]
        used.append(rim if mask is None else rim & mask)
    found = zip(pointmaps, transients.find_transient_masks(pointmaps, pictures, used), used, strict=True)
    return {pointmap.name: hidden & own for pointmap, hidden, own in found if hidden is not None}


def limit_refinement(config: ReconstructionConfig, scene: Scene | None) -> ReconstructionConfig:
    """Returns the configuration with as many steps of refinement as the scene is worth."""
    if scene is None:
        return config
    return msgspec.structs.replace(config, optimize=training.limit_iterations(config.optimize, scene))


def refine_scene(
    scene: Scene | None,
    config: ReconstructionConfig,
    steps: training.RefinementConfig,
    deadline: float | None = None,
    gone_on: Callable[[int], None] = lambda done: None,
) -> Iterator[SceneWithVerdict]:
    """The scene, if there is one, at each checkpoint of its refinement and at its end.

    Where it diverges or overfits it ends with a verdict, and with the best scene so far if that is publishable.
    `deadline` is a time of `time.monotonic()`; `gone_on` hears how many steps are done. The Gaussians are on the
    configured device while they are refined, and those that are shown on the processor. Raises DeviceUnavailable.
    """
    if scene is None:
        return
    scene = scene.move_to_device(choose_device(config.device))
    watching = start_watch(scene, steps.iterations)
    limit = config.most_gaussians
    give_back_memory()
    work = training.refine(scene, steps, seed=config.seed, deadline=deadline, max_gaussians=limit, gone_on=gone_on)
    for later in work:
        give_back_memory()
        verdict = None
        # A scene that started soft shows its photographs after so many steps: looked at earlier, it is not judged.
        looked_at = later.iterations >= training.MIN_SOFT and later.iterations in config.optimize.checkpoints
        if later.losses or looked_at:
            watching, verdict = examine(watching, later)
        if verdict is not None:
            best = (
                prepare_scene_for_display(watching.best.move_to_device(_PROCESSOR), config).scene
                if verdict.publishable
                else None
            )
            yield SceneWithVerdict(best, verdict)
            return
        yield prepare_scene_for_display(later.move_to_device(_PROCESSOR), config)


def snapshot(
    sequence: int,
    conclusion: ReconstructionSummary,
    show: SceneWithVerdict,
    config: ReconstructionConfig,
    *,
    seconds: Mapping[str, float],
    dropped: Collection[DroppedFrame] = (),
    budget: Collection[BudgetHit] = (),
    final: bool = False,
) -> Snapshot:
    """Makes a snapshot of cameras and scene; `seconds` by stage. Only a publishable verdict has a scene.

    The verdict says how many of the scene's pixels have multi-view consistent depth.
    """
    verdict = conclusion.verdict
    if verdict.publishable and show.verdict is not None:
        verdict = show.verdict
    scene = show.scene if verdict.publishable else None
    made = Snapshot(
        sequence=sequence,
        verdict=verdict,
        cameras=_publish_cameras(scene, conclusion, config.frame_set_tolerance_s) if scene else (),
        gaussians=scene.arrays() if scene else GaussianArrays.empty(),
        images=scene.images() if scene else {},
        dropped=tuple(dropped),
        iterations=scene.iterations if scene else 0,
        seconds=dict(seconds),
        budget=tuple(hit.record() for hit in budget),
        final=final,
        served_by=scene.served_by if scene else {},
        evidence=conclusion.evidence_record,
        given=_find_given_world(conclusion) if scene and final else None,
        rig=_find_rig(conclusion) if scene and final else None,
        landmarks=conclusion.landmarks if scene and final else None,
        depths=_find_consistent_depths(scene) if scene and final else {},
        masked={name: view.masked for name, view in conclusion.views.items() if view.masked is not None},
        moving=_moving(conclusion, scene),
        gains=scene.gains() if scene else {},
        gain_sigmas=scene.gain_sigmas() if scene else {},
        falloffs=_falloffs(scene) if scene else {},
    )
    return replace(made, verdict=append_consistent_depth(verdict, made.consistent_depth, config.consistent_depth))


def _publish_cameras(scene: Scene, conclusion: ReconstructionSummary, tolerance_s: float) -> tuple[CameraEstimate, ...]:
    """The cameras of a scene; of several cameras each with its id, and the number of the frame set that it is of."""
    numbers: dict[str, int] = {}
    if any(view.camera_id for view in conclusion.views.values()):
        known = [view for each in scene.views if (view := conclusion.views.get(each.name)) is not None]
        timed = [(view.name, view.camera_id, view.captured_at) for view in known if view.captured_at]
        sets = form_frame_sets(timed, tolerance_s)
        numbers = {name: number for number, each in enumerate(sets) for name in each.names.values()}
    cameras = []
    for camera in scene.cameras():
        view = conclusion.views.get(camera.name, View(camera.name))
        of_view = {"bounds": view.bounds, "captured_at": view.captured_at, "camera_id": view.camera_id}
        cameras.append(replace(camera, **of_view, frame_set=numbers.get(camera.name)))
    return tuple(cameras)


def _find_given_world(conclusion: ReconstructionSummary) -> InGivenWorld | None:
    given = conclusion.given
    if given is None:
        return None
    placed = len(given.held)
    return InGivenWorld(
        given.scale, given.rotation, given.translation, given.scale_sigma, placed, from_depth=given.from_depth
    )


def _find_rig(conclusion: ReconstructionSummary) -> OnRig | None:
    """Returns the rig with one mount a camera: of one that moved, the mount of the most frame sets."""
    rig = conclusion.rig
    if rig is None:
        return None
    mounts = {each.camera_id: each for each in reversed(rig.mounts)}
    mount_rows = tuple((m.camera_id, m.T_rig_camera, m.sigma, m.sigma_deg) for m in reversed(mounts.values()))
    return OnRig(mount_rows, rig.metres_per_unit, rig.scale_sigma, rig.num_given)


def _falloffs(scene: Scene) -> dict[str, float]:
    """Returns the falloff of each image whose vignetting was taken out, by name."""
    lit = {view.name: view.exposure for view in scene.views if view.exposure is not None}
    return {name: exposure.falloff for name, exposure in lit.items() if exposure.falloff}


def _moving(conclusion: ReconstructionSummary, scene: Scene | None) -> dict[str, float]:
    """Returns the share of each image that was left out of matching, or of the scene, because it moved."""
    shares = {name: view.moving for name, view in conclusion.views.items() if view.moving}
    for view in scene.views if scene else ():
        if view.moved:
            shares[view.name] = shares.get(view.name, 0.0) + view.moved
    return shares


def _find_consistent_depths(scene: Scene) -> dict[str, npt.NDArray[np.float16]]:
    """Returns the multi-view consistent depths of each view; it takes below 0.1 s a view."""
    return compute_consistent_depths([view.pointmap for view in scene.views if view.pointmap is not None])


def add_landmarks(made: Snapshot, estimate: Reconstruction | None) -> Snapshot:
    """The snapshot of a scene that grew, to be saved: with the landmarks of `estimate` in the world of its cameras.

    Without landmarks where the estimate is not known any more, or has fewer than two of the cameras.
    """
    landmarks = None if estimate is None else estimate.landmarks
    if landmarks is None:
        return made
    Ts_shown = {camera.name: camera.T_world_camera for camera in made.cameras}
    common = [index for index, name in enumerate(landmarks.names) if name in Ts_shown]
    if len(common) < 2:
        return made
    by = align_cameras(landmarks.Ts_world_camera[common], np.stack([Ts_shown[landmarks.names[i]] for i in common]))
    return replace(made, landmarks=landmarks.transform(by.scale, by.rotation, by.translation))


def format_snapshot(made: Snapshot) -> str:
    """The verdict and what there is of a scene, in a line of a log."""
    seconds = f"after {made.seconds['total']:.1f} s"
    if not made.cameras:
        return f"snapshot {made.sequence}: {made.verdict.code.value}: no scene {seconds}"
    refined = f"refined by {made.iterations} steps" if made.iterations else "coarse so far"
    counts = f"{len(made.cameras)} cameras, {len(made.gaussians)} Gaussians"
    return f"snapshot {made.sequence}: {made.verdict.code.value}: {counts}, {refined}, {seconds}"
