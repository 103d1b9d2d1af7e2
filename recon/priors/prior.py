"""The interface of priors: what gives cameras and points before there is a scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from recon.priors.pointmap import Pointmap
from recon.registration.register import Registration
from recon.view_graph import Matcher, ViewGraph


class Prior(Protocol):
    """A loaded prior. A prior file has `Config`, with at least `registration` and `seed`, and `load(config)`.

    The two steps are apart because the verdict stands between them: refused cameras cost no dense points.
    """

    @property
    def matcher(self) -> Matcher | None:
        """What the view graph shall ask where plain features find few matches."""
        ...

    def register(self, graph: ViewGraph, pause: Callable[[], None] = ...) -> Registration | None:
        """Cameras of the keyframes that hang together, with the evidence for them; None when no two do.

        `pause` is called about once a second; it may raise to abandon the work.
        """
        ...

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, pause: Callable[[], None] = ...
    ) -> tuple[Pointmap, ...]:
        """A point map for each registered camera, in the same order and the same world.

        `pause` is called several times a second; it may raise to abandon the work.
        """
        ...

    def further_pointmaps(
        self, graph: ViewGraph, registration: Registration, known: Mapping[str, Pointmap]
    ) -> tuple[Pointmap, ...]:
        """Point maps of the registered cameras that `known` (by name, in the same world) does not have, in order."""
        ...
