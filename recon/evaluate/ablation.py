"""What each part of the paper brings: alone on the base, and missing from the whole.

The base is InstantSplat with as many iterations, which is the paper's method without its losses. It already refines
poses and thins the points, so these two are only taken away.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import msgspec

from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.scene import pixelwise, seeding

BASE, WHOLE = "instantsplat-xl", "paper"
_LOSSES = {"point-render": "point_render", "depth": "depth", "normal": "normal", "semantic": "semantic"}
_SETTINGS = ("pseudo-views", "down-sampling", "pose-refinement")
_NO_THINNING = seeding.GaussianInitializationConfig(depth_tolerance=0.0)


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
    losses = whole.optimize.regularise.losses

    def replace_regularise(**changes: object) -> ReconstructionConfig:
        changed = msgspec.structs.replace(whole.optimize.regularise, **changes)
        return msgspec.structs.replace(whole, optimize=msgspec.structs.replace(whole.optimize, regularise=changed))

    with_one = {f"{BASE}+{part}": replace_regularise(losses={name: losses[name]}) for part, name in _LOSSES.items()}
    without_one = {
        f"{WHOLE}-{part}": replace_regularise(losses={name: loss for name, loss in losses.items() if name != left_out})
        for part, left_out in _LOSSES.items()
    }
    thick = msgspec.structs.replace(whole.pixelwise or pixelwise.PixelwiseConfig(), down_sampling=_NO_THINNING)
    fixed = msgspec.structs.replace(whole.optimize, refine_poses=False)
    return {
        **with_one,
        **without_one,
        f"{WHOLE}-pseudo-views": replace_regularise(pseudo_views=0),
        f"{WHOLE}-down-sampling": msgspec.structs.replace(whole, pixelwise=thick),
        f"{WHOLE}-pose-refinement": msgspec.structs.replace(whole, optimize=fixed),
    }
