"""Joint refinement of Gaussians and camera poses against the photographs."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Annotated, Literal

import msgspec
import numpy as np
import torch
from msgspec import Meta

from splatnode.capture.process.config_keys import Internal
from splatnode.recon.optimize import ensemble as optimize_ensemble
from splatnode.recon.optimize import photometric_losses, regularizers
from splatnode.recon.optimize.control import prune
from splatnode.recon.optimize.control.control import ControlChoice
from splatnode.recon.optimize.fit import PARAMETERS, Trainer
from splatnode.recon.result.snapshot import SHELL
from splatnode.recon.scene.scene import Gaussians, Scene, TrainingView, logit

# How many threads torch computes with.


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """One thread for torch inside the block, and as many as before after it.

    The core has its own threads; torch's would only wait for each other over the little that is left to them. Their
    number holds for the whole process: a generator must not be suspended inside the block.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


Share = Annotated[float, Meta(ge=0, le=1)]
Rate = Annotated[float, Meta(ge=0, le=1)]
MIN_SOFT = 100  # iterations below which a refinement begins with opacities as seeded


class LearningRates(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Adam's step sizes at the start. Lengths are relative to the median depth of the scene, which is 1."""

    means: Rate = 0.4  # of positions, in `means_unit`
    # extent: standard deviations of each Gaussian along its axes; depth: the median depth, in every direction alike
    means_unit: Internal[Literal["extent", "depth"]] = "extent"
    quats: Rate = 2e-2  # of orientations, as quaternions
    log_scales: Rate = 1e-1  # of the logarithms of the standard deviations
    logit_opacities: Rate = 1e-1  # of the logits of the opacities
    sh: Rate = 3e-2  # of colours, as spherical harmonics
    translation: Internal[Rate] = 2e-4  # of cameras' positions
    rotation: Internal[Rate] = 2e-4  # of cameras' rotations, radians
    final_means: Internal[Share] = 0.1  # part to which the rate of the means has fallen at the end, exponentially
    final: Internal[Share] = 0.3  # part to which the other rates of the Gaussians have fallen
    final_pose: Internal[Share] = 0.1  # part to which those of the cameras have fallen


# Of few steps: steps of a share of a Gaussian's extent take some hundred to settle. Chosen for a refinement of 500.
CAUTIOUS = LearningRates(means=8e-4, means_unit="depth")


class RefinementConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The refinement of the preset `balanced`."""

    iterations: Annotated[int, Meta(ge=0)] = 500  # steps of the optimiser, one view each
    # Iterations after which the scene is shown and judged, besides the last one
    checkpoints: Internal[tuple[int, ...]] = (150,)
    looks: Internal[tuple[int, ...]] = ()  # iterations after which it is shown, too, to somebody who watches
    half_resolution_share: Internal[Share] = 0.0  # share of the iterations, at the start, on images of half the size
    ssim_lambda: Share = 0.4  # weight of D-SSIM in the photometric loss; that of L1 is 1 minus it
    # Largest opacity of what photographs seeded, as the refinement of a begun scene starts: soft Gaussians settle more
    # freely, in a hundred steps and more, so they are left as seeded where a time limit may end it. null: as seeded
    first_opacity: Internal[Annotated[float, Meta(gt=0, lt=1)] | None] = 0.1
    perceptual: photometric_losses.PerceptualLossConfig = (
        photometric_losses.PerceptualLossConfig()
    )  # LPIPS of renders against photographs
    dropout: optimize_ensemble.DropoutConfig = optimize_ensemble.DropoutConfig()
    refine_poses: bool = True  # whether cameras are refined together with the Gaussians
    lr: LearningRates = LearningRates()  # Adam's learning rates at the start; lengths over the median depth
    regularizers: regularizers.RegularizerConfig = (
        regularizers.RegularizerConfig()
    )  # losses beside the photometric one; none by default
    # Density control, which adds and removes Gaussians; None: their number stays
    control: ControlChoice | None = ControlChoice("prune", prune.Config())
    ensemble: optimize_ensemble.EnsembleConfig = optimize_ensemble.EnsembleConfig()

    @property
    def steps(self) -> int:
        """Returns the number of steps of all refinements together."""
        one = self.ensemble.members == 1
        return self.iterations if one else self.ensemble.members * self.iterations + self.ensemble.iterations


def refine(
    scene: Scene,
    config: RefinementConfig,
    *,
    seed: int,
    deadline: float | None = None,
    max_gaussians: int | None = None,
    gone_on: Callable[[int], None] = lambda done: None,
) -> Iterator[Scene]:
    """The scene at every checkpoint and at the end, after at most `config.steps` steps of one view each.

    `deadline` is a time of `time.monotonic()`: the step sizes fall so that they are at their end by then.
    `max_gaussians` is how many there may be at the end; it is for the control to see to that. `gone_on` hears after
    each step how many are done, and may raise to abandon the refinement.
    The first view stays where it is: it is the world. All is computed on the device of the scene's Gaussians, except
    that random numbers are drawn on the processor: they are the same everywhere.

    Of an ensemble the first member is shown until there is a scene that agrees with all of them. Where the deadline
    leaves no time for the others, the first one is the end.
    """
    run = partial(_run_refinement, deadline=deadline, max_gaussians=max_gaussians, gone_on=gone_on)
    if config.ensemble.members == 1:
        yield from run(scene, config, seed=seed)
        return
    started = time.monotonic()
    # Of LPIPS, which takes long, members do without: the refinement after them has it.
    alone = msgspec.structs.replace(config, perceptual=photometric_losses.PerceptualLossConfig())
    first = yield from run(scene, alone, seed=seed)
    took = time.monotonic() - started
    if deadline and started + took * config.steps / max(config.iterations, 1) > deadline:
        return
    members, unseen = [first], msgspec.structs.replace(alone, checkpoints=(), looks=())
    for member in range(1, config.ensemble.members):
        members += run(scene, unseen, seed=optimize_ensemble.seed_of(member, seed), done=member * config.iterations)
    if deadline and time.monotonic() >= deadline:
        return
    with single_torch_thread():
        beside = optimize_ensemble.render_between_views(members, config.ensemble, seed)
    done = sum(member.iterations - scene.iterations for member in members)
    agreeing = replace(first, iterations=scene.iterations + done)
    yield from run(agreeing, _make_agreement_config(config), seed=seed, done=done, beside=beside)


def _run_refinement(
    scene: Scene,
    config: RefinementConfig,
    *,
    seed: int,
    deadline: float | None,
    max_gaussians: int | None,
    gone_on: Callable[[int], None],
    done: int = 0,
    beside: Sequence[TrainingView] = (),
) -> Generator[Scene, None, Scene]:
    """One refinement, after `done` steps of others; its end is returned, too.

    Half of the steps are on the views `beside` those of the scene, if there are any.
    """
    with single_torch_thread():
        fit = Trainer(scene if deadline else _soften_initial_scene(scene, config), config, seed, max_gaussians, beside)
    order = np.random.default_rng(seed)
    own = np.arange(len(scene.views))
    turns = np.concatenate([np.resize(own, max(len(own), len(beside))), len(own) + np.arange(len(beside))])
    started = time.monotonic()
    queue: list[int] = []
    shown = {*config.checkpoints, *config.looks}
    for iteration in range(config.iterations):
        progress = iteration / config.iterations
        if deadline is not None:
            now = time.monotonic()
            if now >= deadline:
                break
            progress = max(progress, (now - started) / max(deadline - started, 1e-9))
        queue = queue or order.permutation(turns).tolist()
        with single_torch_thread():
            fit.step(queue.pop(), progress)
        gone_on(done + iteration + 1)
        if iteration + 1 in shown and iteration + 1 < config.iterations:
            yield fit.scene()
    end = replace(fit.scene(), losses=fit.losses())
    yield end
    return end


def _make_agreement_config(config: RefinementConfig) -> RefinementConfig:
    """Returns the configuration of the refinement after an ensemble."""
    given, rates = config.ensemble, config.lr
    shorter = {name: given.rates * getattr(rates, name) for name in PARAMETERS}
    return msgspec.structs.replace(
        config,
        iterations=given.iterations,
        checkpoints=(),
        looks=(),
        half_resolution_share=0.0,
        lr=msgspec.structs.replace(rates, **shorter),
        control=None,
    )


def _soften_initial_scene(scene: Scene, config: RefinementConfig) -> Scene:
    """A begun scene with its first opacities, if there are steps enough for them to grow.

    How often it is looked at meanwhile does not count: that would make another scene of it.
    """
    if scene.iterations or config.first_opacity is None or config.iterations < MIN_SOFT:
        return scene
    return replace(scene, gaussians=soften_opacities(scene.gaussians, config.first_opacity))


def soften_opacities(gaussians: Gaussians, most: float) -> Gaussians:
    """Limits opacities to `most`, but for the far shell's."""
    logits = gaussians.logit_opacities
    soft = torch.where(gaussians.source_frame == SHELL, logits, logits.clamp_max(logit(most)))
    return replace(gaussians, logit_opacities=soft)
