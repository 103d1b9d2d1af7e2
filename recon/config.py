"""Everything that can be configured in the reconstruction, with defaults and units, in one typed tree."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from capture.config import Plugin, merged, typed
from recon import background, completion, density, judge, optimize, pixelwise, screening
from recon.priors import classical
from recon.verification import verify


class PriorChoice(Plugin):
    """What gives cameras and first points: a module of recon.priors."""

    package = "recon.priors"
    needs = ("Config", "load")
    usual = "classical"


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    size: int = 512  # longer side of the modelled images, pixels
    seed: int = 0
    prior: PriorChoice = PriorChoice("classical", classical.Config())
    screening: screening.Config = screening.Config()
    verification: verify.Config = verify.Config()
    judge: judge.Config = judge.Config()
    completion: completion.Config = completion.Config()
    density: density.Config = density.Config()
    background: background.Config = background.Config()
    pixelwise: pixelwise.Config | None = None  # in place of completion, density and background, for comparison
    preview: optimize.Config = optimize.Config(iterations=30, half_resolution_share=1.0)  # after each keyframe
    optimize: optimize.Config = optimize.Config()  # after the last one
    max_gaussians: int | None = None  # None: as many as the scene calls for
    budget_s: float | None = None  # seconds for everything, from the first frame; None: as many as it takes


PRESETS: dict[str, Config] = {
    "preview": Config(size=384, optimize=optimize.Config(iterations=150)),
    "fast": Config(optimize=optimize.Config(iterations=250)),
    "balanced": Config(),
    "quality": Config(optimize=optimize.Config(iterations=1500, checkpoints=(150, 500))),
}


def preset(name: str) -> Config:
    """The configuration called `name`. Raises ValueError when there is none."""
    if name not in PRESETS:
        raise ValueError(f"no preset {name!r}; there are: {', '.join(PRESETS)}")
    return PRESETS[name]


def overlaid(config: Config, changes: Mapping[str, Any]) -> Config:
    """`config` with `changes` as a file gives them. Raises ConfigError.

    Another kind of prior starts from its own defaults.
    """
    tree = _as_in_files(msgspec.to_builtins(config))
    kind = tree["prior"]["kind"]
    if changes.get("prior", {}).get("kind", kind) != kind:
        tree["prior"] = {}
    return typed(merged(tree, changes), Config)


def _as_in_files(tree: Any) -> Any:
    """The tree with the settings of plug-ins beside their kinds, as files have them."""
    if not isinstance(tree, dict):
        return tree
    if set(tree) == {"kind", "config"}:
        tree = {"kind": tree["kind"], **tree["config"]}
    return {key: _as_in_files(value) for key, value in tree.items()}
