"""Budgets: which of the limits that were asked for bound a scene, and what more would buy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from recon.config import Config
from recon.export.ply import ply_bytes
from recon.scene import Scene
from recon.verdict import Code

STAYS = 0.5  # of the Gaussians that a scene begins with, after pruning without a limit: mean of 4 scenes of 6 views
WINDOW = 0.2  # of the iterations, at the end, from which the slope of the loss is told


@dataclass(frozen=True)
class Hit:
    """A limit that bound the scene."""

    limit: str  # its name in the configuration
    given: float
    would_take: float  # in the same unit: what the scene would have taken by itself, an estimate
    basis: str  # what the estimate rests on, and what is known of the gain

    def record(self) -> dict[str, object]:
        """For report.json."""
        code = Code.BUDGET_HIT.value
        unit = {"max_gaussians": "Gaussians", "max_mb": "MB", "budget_s": "s"}[self.limit]
        wish = f"{self.limit} of {self.given:g} bound the scene, which would take about {self.would_take:g} {unit}"
        return {"code": code, **asdict(self), "message": f"{code}: {wish} ({self.basis})"}


def hits(config: Config, begun: Scene | None, scene: Scene | None, seconds: Mapping[str, float]) -> tuple[Hit, ...]:
    """The limits of `config` that bound `scene`, if there is one, which was refined from `begun` in these seconds."""
    if begun is None or scene is None:
        return ()
    found = (_gaussians(config, begun, scene), _seconds(config, begun, scene, seconds))
    return tuple(hit for hit in found if hit is not None)


def _gaussians(config: Config, begun: Scene, scene: Scene) -> Hit | None:
    most, count = config.most_gaussians, len(scene.gaussians)
    if most is None or count < most or begun.called_for <= most:
        return None
    share = 1.0 if config.optimize.control is None else STAYS
    would_take = max(round(share * begun.called_for), count)
    basis = f"{begun.called_for} pieces of equal colour and depth, of which {share:.0%} stay as a rule"
    if most == config.max_gaussians:
        return Hit("max_gaussians", most, would_take, basis)
    assert config.max_mb is not None  # it is the only other limit
    return Hit("max_mb", config.max_mb, round(ply_bytes(would_take, 1) / 1e6, 2), basis)


def _seconds(config: Config, begun: Scene, scene: Scene, seconds: Mapping[str, float]) -> Hit | None:
    done, planned = scene.iterations - begun.iterations, config.optimize.iterations
    if config.budget_s is None or done >= planned:
        return None
    if not done:
        basis = "cameras and points alone took this long, and nothing was refined"
        return Hit("budget_s", config.budget_s, round(seconds["total"], 1), basis)
    each = seconds.get("optimise", 0.0) / done
    would_take = round(seconds["total"] + each * (planned - done), 1)
    fall = loss_fall(scene.losses) / each
    return Hit(
        "budget_s",
        config.budget_s,
        would_take,
        f"{done} of {planned} iterations were made; the loss fell by {fall:.1%} a second at the end",
    )


def loss_fall(losses: Sequence[float]) -> float:
    """The part of itself by which the loss falls an iteration, at the end; 0 where too few are known."""
    half = round(WINDOW * len(losses)) // 2
    if not half:
        return 0.0
    before, after = sum(losses[-2 * half : -half]), sum(losses[-half:])
    return max(0.0, 1.0 - after / before) / half
