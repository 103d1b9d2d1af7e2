"""Everything that can be configured in the reconstruction, with defaults and units, in one typed tree."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from splatnode.capture.process import plugins
from splatnode.capture.process.config import Internal, Plugin, build_config, merge_config, replace_former_names
from splatnode.capture.process.former_names import RECONSTRUCTION_KEYS
from splatnode.capture.rig import TOLERANCE_S
from splatnode.recon import keyframes
from splatnode.recon.matching import view_graph as matching
from splatnode.recon.metric import measurement as metric
from splatnode.recon.optimize import ensemble, photometric_losses, training
from splatnode.recon.optimize.control import ControlChoice, prune
from splatnode.recon.priors import classical
from splatnode.recon.rasterize import Device
from splatnode.recon.registration import registration
from splatnode.recon.result import stored_snapshot
from splatnode.recon.result.export.formats.ply import compute_max_gaussians
from splatnode.recon.scene import background as scene_background
from splatnode.recon.scene import exposure, initialization, transients
from splatnode.recon.verification import decision, evidence


class PriorChoice(Plugin):
    """A module of recon/priors, or one beside it, which gives depth, and matches that plain features miss."""

    package = "splatnode.recon.priors"
    group = plugins.PRIORS
    needs = ("Config", "load")
    usual = "classical"


# After each keyframe, for a look at once: nothing is pruned or left out.
PREVIEW = training.RefinementConfig(
    iterations=20,
    half_resolution_share=1.0,
    ssim_lambda=0.2,
    first_opacity=None,
    dropout=ensemble.DropoutConfig(share=0.0),
    lr=training.CAUTIOUS,
    control=None,
)


BALANCED = training.RefinementConfig(doubtful_iterations=200)


class FallbackConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The fallbacks, tried before images are rejected or left out for want of matches."""

    # Work up to which a further fallback begins, about seconds of one idle core. It counts operations, not time, so
    # that results do not depend on the machine
    budget: Annotated[float, Meta(ge=0)] = 4.0
    # Time after which no further fallback begins, by the clock. None: no clock decides; in a node it is 4
    timeout_s: Annotated[float, Meta(ge=0)] | None = None


class ReconstructionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    former_keys = RECONSTRUCTION_KEYS

    size: Annotated[int, Meta(ge=64)] = 512  # longer side of the modelled images, pixels
    # Of the generators of random numbers: the same seed and photographs give the same scene
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
    device: Device = "cpu"  # that Gaussians are refined on; cuda was run by us on NVIDIA H200s alone
    no_fallbacks: bool = False  # reject at once: try no fallback first
    # What gives depth, and matches that plain features miss
    prior: PriorChoice = PriorChoice("classical", classical.Config())
    screening: keyframes.ScreeningConfig = keyframes.ScreeningConfig()
    matching: matching.MatchingConfig = matching.MatchingConfig()
    registration: registration.RegistrationConfig = registration.RegistrationConfig()
    verification: Internal[evidence.VerificationConfig] = evidence.VerificationConfig()
    decision: decision.DecisionConfig = decision.DecisionConfig()
    fallbacks: FallbackConfig = FallbackConfig()
    exposure_compensation: exposure.ExposureConfig = exposure.ExposureConfig()
    transient_mask: transients.TransientMaskConfig = transients.TransientMaskConfig()
    completion: Internal[scene_background.DepthCompletionConfig] = scene_background.DepthCompletionConfig()
    initialization: initialization.GaussianInitializationConfig = initialization.GaussianInitializationConfig()
    background: scene_background.BackgroundConfig = scene_background.BackgroundConfig()
    # In place of completion, initialization and background: a Gaussian a pixel, for comparison
    pixelwise: Internal[initialization.PixelwiseConfig | None] = None
    preview: Internal[training.RefinementConfig] = PREVIEW  # the refinement after each keyframe
    optimize: training.RefinementConfig = BALANCED  # the refinement after the last keyframe
    metric: metric.MetricConfig = metric.MetricConfig()  # the scale in metres of what is published
    # Images of several cameras were taken together, as a frame set, where their times are no further apart; seconds
    frame_set_tolerance_s: Annotated[float, Meta(gt=0, le=10)] = TOLERANCE_S
    # From how much depth that other views confirm a scene counts as seen, also away from the cameras
    consistent_depth: Internal[stored_snapshot.ConsistentDepthConfig] = stored_snapshot.ConsistentDepthConfig()
    # At most so many in the scene; None: as many as it calls for
    max_gaussians: Annotated[int, Meta(ge=1)] | None = None
    max_mb: Annotated[float, Meta(gt=0)] | None = None  # largest scene.ply, in 10^6 bytes; None: as large as it gets
    # With such a limit a scene begins with this many times as many; its control leaves the best
    surplus: Internal[float] = 2.0
    # For all, from the first photograph on; None: as long as it takes. The daemon has no such limit
    budget_s: Annotated[float, Meta(gt=0)] | None = None

    @property
    def most_gaussians(self) -> int | None:
        """How many the scene may have, by both limits; None: there is none."""
        by_size = None if self.max_mb is None else compute_max_gaussians(round(self.max_mb * 1e6))
        limits = [limit for limit in (self.max_gaussians, by_size) if limit is not None]
        return min(limits, default=None)

    @property
    def first_gaussians(self) -> int | None:
        """How many it may begin with."""
        most = self.most_gaussians
        return most if most is None or self.optimize.control is None else round(self.surplus * most)

    @property
    def scene_initialization(self) -> initialization.SceneInitializationConfig:
        """Returns the configuration of the initial Gaussians of a scene."""
        most = self.first_gaussians
        return initialization.SceneInitializationConfig(
            self.completion, self.initialization, self.background, self.pixelwise, most
        )


PRESETS: dict[str, ReconstructionConfig] = {
    "preview": ReconstructionConfig(
        size=384, optimize=msgspec.structs.replace(BALANCED, half_resolution_share=0.25, iterations=150)
    ),
    "fast": ReconstructionConfig(optimize=msgspec.structs.replace(BALANCED, iterations=200)),
    "balanced": ReconstructionConfig(),
    # Two scenes and one that agrees with both. For texture: two thirds more Gaussians, and LPIPS where its weights are
    "quality": ReconstructionConfig(
        initialization=initialization.GaussianInitializationConfig(max_error=0.0009),
        optimize=msgspec.structs.replace(
            BALANCED,
            checkpoints=(150, 500),
            ensemble=ensemble.EnsembleConfig(members=2),
            perceptual=photometric_losses.PerceptualLossConfig(weight=0.08, start=0.0, every=2),
            control=ControlChoice("prune", prune.Config(least_change=0.00125)),
        ),
    ),
}


def preset(name: str) -> ReconstructionConfig:
    """The configuration called `name`. Raises ValueError when there is none."""
    if name not in PRESETS:
        raise ValueError(f"no preset {name!r}; there are: {', '.join(PRESETS)}")
    return PRESETS[name]


def apply_changes(config: ReconstructionConfig, changes: Mapping[str, Any]) -> ReconstructionConfig:
    """`config` with `changes` as a file gives them. Raises ConfigError.

    Another kind of prior starts from its own defaults.
    """
    tree = _flatten_plugins(msgspec.to_builtins(config))
    kind, prior = tree["prior"]["kind"], changes.get("prior")
    if isinstance(prior, Mapping) and prior.get("kind", kind) != kind:
        tree["prior"] = {}
    present = replace_former_names(changes, ReconstructionConfig, tree)
    return build_config(merge_config(tree, present), ReconstructionConfig)


def _flatten_plugins(tree: Any) -> Any:
    """The tree with the settings of plug-ins beside their kinds, as files have them."""
    if not isinstance(tree, dict):
        return tree
    if set(tree) == {"kind", "config"}:
        tree = {"kind": tree["kind"], **tree["config"]}
    return {key: _flatten_plugins(value) for key, value in tree.items()}
