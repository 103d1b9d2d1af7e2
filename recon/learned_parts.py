"""The learned parts: what each is for, and whether it can be used here: its package, its weights and their licence.

A prior's module says by itself what it takes: `WEIGHTS` are its files' paths in the catalogue of weights, `PACKAGE` is
the import name of what it needs beside torch. A prior without `WEIGHTS` is not learned.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

from splatnode.recon.config import PriorChoice
from splatnode.recon.networks import depth_anything
from splatnode.recon.networks import weights as networks_weights
from splatnode.recon.networks.weights import Weights, find_mismatch, locate_weights
from splatnode.recon.optimize.losses import semantic


@dataclass(frozen=True)
class LearnedPart:
    """Something that can only be used with weights from elsewhere."""

    name: str
    purpose: str
    weights: tuple[str, ...]  # paths in the catalogue
    package: str | None = None  # import name of what it needs beside torch

    @property
    def licence(self) -> str:
        """Returns the licence of the weights; empty where the catalogue does not have them."""
        known = _catalogue()
        return "; ".join(dict.fromkeys(known[path].licence for path in self.weights if path in known))


OTHERS = (
    LearnedPart("mono depth", "depth and normal losses", (depth_anything.RELATIVE,)),
    LearnedPart("dinov2", "semantic loss", (semantic.WEIGHTS,)),
    LearnedPart("metric", "metres indoors", (depth_anything.METRIC,)),
)


def list_learned_parts() -> tuple[LearnedPart, ...]:
    """The priors that have weights, in recon/priors or beside it, and the networks of other rooms."""
    return (*_priors(), *OTHERS)


def find_unavailable_reason(part: LearnedPart) -> str:
    """Returns why `part` is unavailable, and the remedy; empty if it is available, as far as digests tell."""
    if part.package is not None and not importlib.util.find_spec(part.package):
        return f"pip install {part.package}"
    known = _catalogue()
    for path in part.weights:
        if path not in known:
            return f"{path} is not in the catalogue of weights: recon/networks/weights.py needs its entry"
        entry, file = known[path], locate_weights(path)
        if file is None:
            return f"no weights: splatnode weights fetch {entry.name}" if entry.url else f"no weights: see {entry.name}"
        if wrong := find_mismatch(entry, file):
            return f"{file}: {wrong}; splatnode weights fetch {entry.name}"
    return ""


def _priors() -> list[LearnedPart]:
    modules = {kind: PriorChoice.load_module(kind) for kind in PriorChoice.kinds()}
    return [
        LearnedPart(kind, "prior", module.WEIGHTS, getattr(module, "PACKAGE", None))
        for kind, module in modules.items()
        if hasattr(module, "WEIGHTS")
    ]


def _catalogue() -> dict[str, Weights]:
    """The catalogue's entries by their paths."""
    return {entry.path: entry for entry in networks_weights.CATALOGUE}
