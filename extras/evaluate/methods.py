"""The methods that a benchmark compares, by name: our presets, further configurations of our engine, and rivals."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from types import MappingProxyType
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.config import PRESETS, ReconstructionConfig
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.modelling import create_initial_scene
from splatnode.recon.optimize import ensemble, regularizers, training
from splatnode.recon.optimize.losses import LossChoice, depth, normal, point_render, semantic
from splatnode.recon.pipeline import estimate_frames, model_scene, reconstruct
from splatnode.recon.priors import Pointmap
from splatnode.recon.rasterize import Device
from splatnode.recon.result.report import peak_rss_mb
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.scene import Scene, background, initialization
from splatnode.recon.threads import Clock

# The methods that a benchmark compares, by name: our presets, and others as configurations of the same engine.
#
# Methods that are configurations get the same cameras and point maps, so that what differs is how a scene is made of
# them. InstantSplat and the paper start as published; and with our far shell, or our filled depths and it (`+shell`,
# `+fill`): their own depth has no holes, ours leaves 12 to 25 % of the pixels without a point.

# What each part of the paper brings: alone on the base, and missing from the whole.
#
# The base is InstantSplat with as many iterations, which is the paper's method without its losses. It already refines
# poses and thins the points, so these two are only taken away.

BASE, WHOLE = "instantsplat-xl", "paper"
_LOSSES = {"point-render": "point_render", "depth": "depth", "normal": "normal", "semantic": "semantic"}
_SETTINGS = ("pseudo-views", "down-sampling", "pose-refinement")
_NO_THINNING = initialization.GaussianInitializationConfig(depth_tolerance=0.0)


@dataclass(frozen=True)
class Variant:
    method: str
    against: str


def list_names() -> tuple[str, ...]:
    """Base, each loss alone, the whole, and the whole without each part."""
    with_one = (f"{BASE}+{part}" for part in _LOSSES)
    without_one = (f"{WHOLE}-{part}" for part in (*_LOSSES, *_SETTINGS))
    return BASE, *with_one, WHOLE, *without_one


def is_variant(method: str) -> bool:
    """Whether a method exists for the ablation alone."""
    return method in list_names() and method not in (BASE, WHOLE)


def list_variants(methods: Collection[str]) -> list[Variant]:
    """Those of `methods` that the ablation compares, in order."""
    found = [name for name in list_names() if name in methods]
    return [Variant(name, WHOLE if name.startswith(f"{WHOLE}-") else BASE) for name in found]


def make_configs(whole: ReconstructionConfig) -> dict[str, ReconstructionConfig]:
    """The variants that are no methods by themselves, by name."""
    losses = whole.optimize.regularizers.losses

    def replace_regularise(**changes: object) -> ReconstructionConfig:
        changed = msgspec.structs.replace(whole.optimize.regularizers, **changes)
        return msgspec.structs.replace(whole, optimize=msgspec.structs.replace(whole.optimize, regularizers=changed))

    with_one = {f"{BASE}+{part}": replace_regularise(losses={name: losses[name]}) for part, name in _LOSSES.items()}
    without_one = {
        f"{WHOLE}-{part}": replace_regularise(losses={name: loss for name, loss in losses.items() if name != left_out})
        for part, left_out in _LOSSES.items()
    }
    thick = msgspec.structs.replace(whole.pixelwise or initialization.PixelwiseConfig(), down_sampling=_NO_THINNING)
    fixed = msgspec.structs.replace(whole.optimize, refine_poses=False)
    return {
        **with_one,
        **without_one,
        f"{WHOLE}-pseudo-views": replace_regularise(pseudo_views=0),
        f"{WHOLE}-down-sampling": msgspec.structs.replace(whole, pixelwise=thick),
        f"{WHOLE}-pose-refinement": msgspec.structs.replace(whole, optimize=fixed),
    }


# The cameras and points of a set of photographs, found once for all methods that would find the same.


@dataclass(frozen=True, eq=False)
class Start:
    """Cameras and depth, no Gaussians yet; it is sent from process to process, and serves several reconstructions."""

    estimate: Reconstruction
    dropped: list[DroppedFrame]
    clock: Clock
    peak_rss_mb: float | None

    @property
    def seconds(self) -> float:
        """Returns the seconds that it took so far."""
        return self.clock.last - self.clock.started


def extract_start_config(config: ReconstructionConfig) -> ReconstructionConfig:
    """The part of a configuration that decides cameras and points; all else is at its defaults."""
    return ReconstructionConfig(
        size=config.size,
        prior=config.prior,
        matching=config.matching,
        registration=config.registration,
        screening=config.screening,
        verification=config.verification,
        decision=config.decision,
        no_fallbacks=config.no_fallbacks,
        fallbacks=config.fallbacks,
    )


def find_start(frames: Sequence[Frame], config: ReconstructionConfig) -> Start:
    """Cameras and depth as `config` finds them, or a verdict that forbids them."""
    clock = Clock()
    estimate, dropped = estimate_frames(frames, config, clock)
    return Start(estimate, dropped, clock, peak_rss_mb())


def continue_reconstruction(start: Start, config: ReconstructionConfig) -> Iterator[Snapshot]:
    """Yields what `reconstruct` gives from here on with `config`; the clock resumes where it stopped."""
    clock = replace(start.clock, seconds=dict(start.clock.seconds))
    clock.resume()
    begun = create_initial_scene(start.estimate, config)
    yield from model_scene(start.estimate.summary, begun, start.dropped, config, clock)


# Iterations at which a configuration shows its scene, besides its end
CHECKPOINTS = (training.MIN_SOFT, 150, 500)

# InstantSplat's released settings (2025): a Gaussian a pixel, nothing added or taken away; colours, scales and turns
# ten times as fast as in 3DGS; steps that do not fall, but for the poses', which fall to a hundredth.
_INSTANTSPLAT_RATES = training.LearningRates(
    means=1.6e-4,
    means_unit="depth",
    quats=1e-2,
    log_scales=5e-2,
    logit_opacities=5e-2,
    sh=2.5e-2,
    translation=1e-4,
    rotation=1e-4,
    final_means=1.0,
    final=1.0,
    final_pose=0.01,
)

# The publication's losses, with its weights and the parts of the refinement in which they count.
_PAPER_LOSSES = {
    "point_render": LossChoice("point_render", point_render.Config(0.25, 0.1, 0.8, compare_unseen=True)),
    "depth": LossChoice("depth", depth.Config(0.05, 0.2, 0.7)),
    "normal": LossChoice("normal", normal.Config(0.01, 0.2, 0.7)),
    "semantic": LossChoice("semantic", semantic.Config(0.5, 0.1, 0.8)),
}


def _make_instantsplat_config(iterations: int, losses: Mapping[str, LossChoice]) -> ReconstructionConfig:
    return ReconstructionConfig(
        pixelwise=initialization.PixelwiseConfig(),
        optimize=training.RefinementConfig(
            iterations=iterations,
            ssim_lambda=0.2,
            dropout=ensemble.DropoutConfig(share=0.0),
            control=None,
            lr=_INSTANTSPLAT_RATES,
            regularizers=regularizers.RegularizerConfig(losses),
        ),
    )


def _add_checkpoints(config: ReconstructionConfig) -> ReconstructionConfig:
    """The same, shown on its way at iterations that are the same for all methods."""
    watched = msgspec.structs.replace(config.optimize, checkpoints=CHECKPOINTS)
    return msgspec.structs.replace(config, optimize=watched)


_PAPER = _make_instantsplat_config(1000, _PAPER_LOSSES)
_PIXELWISE = {
    "instantsplat-s": _make_instantsplat_config(200, {}),
    BASE: _make_instantsplat_config(1000, {}),
    WHOLE: _PAPER,
}
DENSE_CONFIDENCE = 0.05  # from which on points are rendered and depths compared, where the depth has no holes


def add_surroundings(config: ReconstructionConfig, surroundings: Literal["shell", "fill"]) -> ReconstructionConfig:
    """A start with what ours has around the pixels that stereo knows, where MASt3R would know all of them."""
    by_pixel = msgspec.structs.replace(config.pixelwise or initialization.PixelwiseConfig(), surroundings=surroundings)
    if surroundings == "fill":
        losses = msgspec.structs.replace(config.optimize.regularizers, min_confidence=DENSE_CONFIDENCE)
        config = msgspec.structs.replace(config, optimize=msgspec.structs.replace(config.optimize, regularizers=losses))
    return msgspec.structs.replace(config, pixelwise=by_pixel)


SURROUNDED: dict[str, ReconstructionConfig] = {
    f"{name}+{surroundings}": add_surroundings(config, surroundings)
    for name, config in _PIXELWISE.items()
    for surroundings in ("shell", "fill")
}
CONFIGS: dict[str, ReconstructionConfig] = {
    name: _add_checkpoints(config)
    for name, config in {
        **PRESETS,
        **_PIXELWISE,
        **SURROUNDED,
        **make_configs(_PAPER),
    }.items()
}

Method = Callable[[Sequence[Frame], int], Iterator[Snapshot]]  # photographs and a seed in, the scene as it grows out


def _reconstruct_by_config(config: ReconstructionConfig, frames: Sequence[Frame], seed: int) -> Iterator[Snapshot]:
    return reconstruct(frames, msgspec.structs.replace(config, seed=seed))


def _reconstruct_by_rival(name: str, frames: Sequence[Frame], seed: int) -> Iterator[Snapshot]:
    """The method of the module of splatnode.extras.evaluate.rivals that is called like it, `+published` or not."""
    name, _, budget = name.partition("+")
    module = import_module(f"splatnode.extras.evaluate.rivals.{name.replace('-', '_')}")
    return module.reconstruct(frames, seed, module.PUBLISHED) if budget else module.reconstruct(frames, seed)


_OF_GAUSSIANS = ("colmap-3dgs", "colmap-fsgs", "cf-3dgs")
RIVALS = (*_OF_GAUSSIANS, "nerfmm", "nope-nerf")  # these make their own cameras
PUBLISHED = tuple(f"{name}+published" for name in _OF_GAUSSIANS)  # with as many iterations as the publications
METHODS: dict[str, Method] = {
    **{name: partial(_reconstruct_by_config, config) for name, config in CONFIGS.items()},
    **{name: partial(_reconstruct_by_rival, name) for name in (*RIVALS, *PUBLISHED)},
}
SETS = {
    "presets": tuple(PRESETS),
    "rivals": RIVALS,
    "published": PUBLISHED,
    "surrounded": tuple(SURROUNDED),
    "ablation": list_names(),
}


def find_method(name: str) -> Method:
    """The method called `name`. Raises ValueError when there is none."""
    if name not in METHODS:
        listed = [each for each in METHODS if not is_variant(each)]
        raise ValueError(f"no method {name!r}; there are: {', '.join(listed)}, and the sets {', '.join(SETS)}")
    return METHODS[name]


def expand_method_names(names: Sequence[str]) -> tuple[str, ...]:
    """`names` with the sets among them spelt out. Raises ValueError where there is no such method."""
    found = tuple(dict.fromkeys(name for each in names for name in SETS.get(each, (each,))))
    for name in found:
        find_method(name)
    return found


def select_start_config(name: str) -> ReconstructionConfig | None:
    """Returns what decides the cameras and points that a method starts from; None if it finds its own."""
    return extract_start_config(CONFIGS[name]) if name in CONFIGS else None


def run_method(
    frames: Sequence[Frame], name: str, seed: int, start: Start | None = None, device: Device = "cpu"
) -> Iterator[Snapshot]:
    """Runs the method called `name`, from where `start` stands if it is given one that `select_start_config` asks for.

    `device` is for methods that are configurations; rivals are measured on the processor. At module level, so that a
    fresh process can be told to run it.
    """
    if start is None:
        return find_method(name)(frames, seed)
    return continue_reconstruction(start, msgspec.structs.replace(CONFIGS[name], seed=seed, device=device))


# The snapshots and verdicts of a rival. It publishes whatever it finds: its only refusal is to find nothing.

MIN_CAMERAS = 3  # a model of two cameras counts as no answer, for every method


def make_verdict(frames: Sequence[Frame], registered: Collection[str]) -> Verdict:
    """Returns the verdict where cameras of the frames named `registered` were found."""
    missing = tuple(frame.name for frame in frames if frame.name not in registered)
    sentence = f"{len(registered)} of {len(frames)} photographs were placed."
    if len(registered) < MIN_CAMERAS:
        return Verdict(Code.NO_OVERLAP, sentence, "", missing)
    return Verdict(Code.OK_PARTIAL if missing else Code.OK, sentence, "", missing, publishable=True)


def make_refusal(frames: Sequence[Frame], clock: Clock) -> Snapshot:
    """No scene, because too few cameras were found."""
    return Snapshot(
        sequence=1,
        verdict=make_verdict(frames, ()),
        cameras=(),
        gaussians=GaussianArrays.empty(),
        images={},
        dropped=(),
        iterations=0,
        seconds=clock.stage_seconds,
        final=True,
    )


def make_snapshot(frames: Sequence[Frame], scene: Scene) -> Snapshot:
    """Makes the snapshot of Gaussians and the cameras that they were fitted with."""
    return Snapshot(
        sequence=0,
        verdict=make_verdict(frames, {view.name for view in scene.views}),
        cameras=scene.cameras(),
        gaussians=scene.arrays(),
        images={},
        dropped=(),
        iterations=scene.iterations,
        served_by=scene.served_by,
    )


def number_snapshots(
    snapshots: Iterable[Snapshot], clock: Clock, served_by: Mapping[str, str] = MappingProxyType({})
) -> Iterator[Snapshot]:
    """The snapshots that an optimisation gives, numbered and timed as "optimise", and the last one again as final.

    `served_by` names what took the place of networks that the publication has.
    """
    last = None
    for sequence, snapshot in enumerate(snapshots, 1):
        clock.lap("optimise")
        last = replace(
            snapshot, sequence=sequence, seconds=clock.stage_seconds, served_by={**snapshot.served_by, **served_by}
        )
        yield last
        clock.lap("wait")
    assert last is not None  # an optimisation gives its end
    yield replace(last, sequence=last.sequence + 1, final=True)


# A depth for every pixel of a photograph, where a rival's publication has a monocular network.
#
# What serves is splatnode's own multi-view depth, its gaps filled from their surroundings, and the focal length that
# was estimated with it. Unlike a network's, these depths are right up to one scale that all views share: that helps a
# rival.

_SERVED_BY = {"depth": "multi-view depth"}


@dataclass(frozen=True, eq=False)
class FrameWithDepth:
    """A photograph with its depth. The pose of its camera is not given."""

    name: str
    frame_id: int
    image: npt.NDArray[np.uint8]  # (h, w, 3) RGB at modelled size
    depth: npt.NDArray[np.float32]  # (h, w) z, everywhere
    K: npt.NDArray[np.float64]  # (3, 3)
    mask: npt.NDArray[np.bool_] | None = None  # (h, w) False: not used; None: all is


def optimize_with_depth(
    frames: Sequence[Frame], seed: int, learnt: Callable[[tuple[FrameWithDepth, ...], Clock], Iterable[Snapshot]]
) -> Iterator[Snapshot]:
    """The snapshots that `learnt` makes of the frames with their depth; one refusal where fewer than three have one.

    The clock is for what `learnt` does before its first snapshot.
    """
    clock = Clock()
    known = estimate_frame_depths(frames, seed)
    clock.lap("points")
    if len(known) < MIN_CAMERAS:
        yield make_refusal(frames, clock)
    else:
        yield from number_snapshots(learnt(known, clock), clock, _SERVED_BY)


def estimate_frame_depths(frames: Sequence[Frame], seed: int) -> tuple[FrameWithDepth, ...]:
    """The frames whose depth is known, in their order; none where splatnode itself refuses the frames."""
    config = ReconstructionConfig(seed=seed)
    estimate, _ = estimate_frames(frames, config, Clock())
    begun = create_initial_scene(estimate, config)
    if begun is None:
        return ()
    views = sorted(begun.views, key=lambda view: view.frame_id)
    masked = {frame.name for frame in frames if frame.mask is not None}  # what views see through a rival is not told
    return tuple(
        FrameWithDepth(
            view.name,
            view.frame_id,
            view.image,
            _fill_depth(view.pointmap, view.image),
            view.K.double().numpy(),
            view.mask if view.name in masked else None,
        )
        for view in views
        if view.pointmap is not None
    )


def _fill_depth(pointmap: Pointmap, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    settings = background.DepthCompletionConfig()
    known = background.mask_doubtful(pointmap, settings)
    return np.where(known.depth > 0, known.depth, background.smooth_depth(known, image, settings)).astype(np.float32)
