"""Budgets: which of the limits that were asked for bound a scene, and what more would buy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.result.export.formats.ply import compute_ply_bytes
from splatnode.recon.result.verdict import Code
from splatnode.recon.scene.scene import Scene

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
            "cameras": seconds.get("poses", 0.0) + seconds.get("ladder", 0.0),
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
