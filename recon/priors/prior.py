"""The interface of priors: a prior proposes matches that plain features miss, and gives depth to registered cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from splatnode.recon.matching.view_graph import Matcher, ViewGraph
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.registration.register import Registration


class Prior(Protocol):
    """A loaded prior. Its module has `Config`, with at least `seed`, and `load(config)`.

    Cameras come from `recon.registration` whatever the prior is; the verdict stands between them and the depth:
    cameras that were refused cost no depth.
    """

    matcher: Matcher | None  # what the view graph asks where plain features find few matches

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, pause: Callable[[], None] = lambda: None
    ) -> tuple[Pointmap, ...]:
        """A point map for each registered camera, in the same order and the same world.

        `pause` is called several times a second; it may raise to abandon the work.
        """
        ...

    def further_pointmaps(
        self, graph: ViewGraph, registration: Registration, known: Mapping[str, Pointmap]
    ) -> tuple[Pointmap, ...]:
        """Point maps of the registered cameras that `known` (by name, in the same world) does not have, in order."""
        return tuple(found for found in self.pointmaps(graph, registration) if found.name not in known)
