"""The interface of priors. A new prior is one file or folder of recon/priors, and no line elsewhere.

Its module has `Config`, a Struct with at least `seed`, and `load(config)`; `splatnode.recon.learned_parts` says what a
module with learned weights has beside them. The weights need an entry in recon/networks/weights.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Protocol

from splatnode.recon.matching.view_graph import Matcher, ViewGraph
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.registration.registration import Registration


class Prior(Protocol):
    """A loaded prior. It proposes matches that plain features miss, and gives depth to registered cameras.

    Cameras come from `recon.registration` whatever the prior is. The verdict on them comes before depth is asked for,
    so that cameras which are refused cost none.
    """

    matcher: Matcher | None  # what the view graph asks where plain features find few matches
    ends_early: bool = False  # whether `pause` may raise OutOfTime, after which depth comes soon and coarser

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, pause: Callable[[], None] = lambda: None
    ) -> tuple[Pointmap, ...]:
        """A point map for each registered camera, in the order and the world of `registration`.

        `pause` is called several times a second; it may raise to abandon the work.
        """
        ...

    def further_pointmaps(
        self, graph: ViewGraph, registration: Registration, known: Mapping[str, Pointmap]
    ) -> tuple[Pointmap, ...]:
        """Point maps of the registered cameras that `known` (by name, in the same world) does not have, in their order.

        A prior that can add one view to others does better than this default, which computes all anew.
        """
        return tuple(found for found in self.pointmaps(graph, registration) if found.name not in known)


def apply_image_masks(pointmaps: Iterable[Pointmap], graph: ViewGraph) -> dict[str, Pointmap]:
    """The point maps by name, where nothing is known of what a mask hides."""
    masks = {keyframe.name: keyframe.mask for keyframe in graph.keyframes}
    return {pointmap.name: pointmap.apply_image_mask(masks[pointmap.name]) for pointmap in pointmaps}
