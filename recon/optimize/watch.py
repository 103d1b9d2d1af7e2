"""What is asked of a scene at each checkpoint of its refinement, and at the end: has it diverged, is it overfitted?"""

from __future__ import annotations

from dataclasses import dataclass, replace

from splatnode.recon.optimize import divergence, overfitting
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.scene.scene import Scene
from splatnode.recon.verification import acceptances

# Iterations up to which a refinement is not tested for overfitting, because the test takes as long as 10 of them: no
# set of photographs lost held-out quality within 200.
SHORT = 250


@dataclass(frozen=True, eq=False)
class RefinementWatch:
    """The reference that later scenes of a refinement are compared with."""

    begun_misfit: float  # photometric loss of the scene before the refinement
    expectations: tuple[overfitting.ExpectedView, ...]  # between the photographs
    best: Scene  # of those so far, the one that fits the expectations best
    best_misfit: float  # of that one with the expectations


def start_watch(begun: Scene, iterations: int) -> RefinementWatch:
    """The watch over a refinement of `begun` in so many iterations."""
    expectations = overfitting.make_expectations(begun) if iterations > SHORT else ()
    return RefinementWatch(
        divergence.misfit(begun), expectations, begun, overfitting.misfit(expectations, begun.gaussians)
    )


def examine(watch: RefinementWatch, later: Scene) -> tuple[RefinementWatch, Verdict | None]:
    """The watch over what comes after `later`, and a verdict where the refinement should end with it; else None.

    DIVERGED is not publishable: there is no scene. OVERFIT is publishable with the scene `watch.best`.
    """
    diverged = divergence.check_divergence(watch.begun_misfit, later)
    if diverged is not None:
        return watch, diverged
    misfit = overfitting.misfit(watch.expectations, later.gaussians)
    if misfit > overfitting.OVERFITTED * watch.best_misfit:
        names = [view.name for view in later.views]
        kept = watch.best.iterations
        return watch, acceptances.make_overfit_verdict(names, later.iterations, kept, watch.best_misfit, misfit)
    if misfit < watch.best_misfit:
        watch = replace(watch, best=later, best_misfit=misfit)
    return watch, None
