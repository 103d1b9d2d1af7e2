"""The methods that a benchmark compares, by name: our presets, and others as configurations of the same engine.

Methods that are configurations get the same cameras and point maps, so that what differs is how a scene is made of
them. InstantSplat and the paper start as published; and with our far shell, or our filled depths and it (`+shell`,
`+fill`): their own depth has no holes, ours leaves 12 to 25 % of the pixels without a point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Literal

import msgspec

from splatnode.capture.frame import Frame
from splatnode.recon.config import PRESETS, ReconstructionConfig
from splatnode.recon.evaluate import ablation
from splatnode.recon.evaluate.start import Start, continue_reconstruction, extract_start_config
from splatnode.recon.optimize import dropout, refinement, regularise
from splatnode.recon.optimize.losses import depth, normal, point_render, semantic
from splatnode.recon.optimize.losses.loss import LossChoice
from splatnode.recon.pipeline import reconstruct
from splatnode.recon.rasterize.device import Device
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.scene import pixelwise

# Iterations at which a configuration shows its scene, besides its end
CHECKPOINTS = (refinement.MIN_SOFT, 150, 500)

# InstantSplat's released settings (2025): a Gaussian a pixel, nothing added or taken away; colours, scales and turns
# ten times as fast as in 3DGS; steps that do not fall, but for the poses', which fall to a hundredth.
_INSTANTSPLAT_RATES = refinement.LearningRates(
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
        pixelwise=pixelwise.PixelwiseConfig(),
        optimize=refinement.RefinementConfig(
            iterations=iterations,
            dssim=0.2,
            dropout=dropout.DropoutConfig(share=0.0),
            control=None,
            rates=_INSTANTSPLAT_RATES,
            regularise=regularise.RegularizerConfig(losses),
        ),
    )


def _add_checkpoints(config: ReconstructionConfig) -> ReconstructionConfig:
    """The same, shown on its way at iterations that are the same for all methods."""
    watched = msgspec.structs.replace(config.optimize, checkpoints=CHECKPOINTS)
    return msgspec.structs.replace(config, optimize=watched)


_PAPER = _make_instantsplat_config(1000, _PAPER_LOSSES)
_PIXELWISE = {
    "instantsplat-s": _make_instantsplat_config(200, {}),
    ablation.BASE: _make_instantsplat_config(1000, {}),
    ablation.WHOLE: _PAPER,
}
DENSE_CONFIDENCE = 0.05  # from which on points are rendered and depths compared, where the depth has no holes


def add_surroundings(config: ReconstructionConfig, surroundings: Literal["shell", "fill"]) -> ReconstructionConfig:
    """A start with what ours has around the pixels that stereo knows, where MASt3R would know all of them."""
    by_pixel = msgspec.structs.replace(config.pixelwise or pixelwise.PixelwiseConfig(), surroundings=surroundings)
    if surroundings == "fill":
        losses = msgspec.structs.replace(config.optimize.regularise, min_confidence=DENSE_CONFIDENCE)
        config = msgspec.structs.replace(config, optimize=msgspec.structs.replace(config.optimize, regularise=losses))
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
        **ablation.make_configs(_PAPER),
    }.items()
}

Method = Callable[[Sequence[Frame], int], Iterator[Snapshot]]  # photographs and a seed in, the scene as it grows out


def _reconstruct_by_config(config: ReconstructionConfig, frames: Sequence[Frame], seed: int) -> Iterator[Snapshot]:
    return reconstruct(frames, msgspec.structs.replace(config, seed=seed))


def _reconstruct_by_rival(name: str, frames: Sequence[Frame], seed: int) -> Iterator[Snapshot]:
    """The method of the module of splatnode.recon.evaluate.rivals that is called like it, `+published` or not."""
    name, _, budget = name.partition("+")
    module = import_module(f"splatnode.recon.evaluate.rivals.{name.replace('-', '_')}")
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
    "ablation": ablation.list_names(),
}


def find_method(name: str) -> Method:
    """The method called `name`. Raises ValueError when there is none."""
    if name not in METHODS:
        listed = [each for each in METHODS if not ablation.is_variant(each)]
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
