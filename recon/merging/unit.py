"""The unit and the up of a map: those of its first scene, and how well they are known in the others.

The others hang on the first one by links. Where a scene lies by all links together is known no worse than by any one
way along them; so the way of the fewest links bounds how wrong its scale and its rotation are to those of the first. By
that much more than the first scene's, and independently, they may be wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from splatnode.capture.process.printable import LONGEST_TEXT
from splatnode.recon.result.bounds_in_words import format_rounded_up
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.scale import TWO_SIDED_95, Scale
from splatnode.recon.result.stored_snapshot import read_up
from splatnode.recon.result.up import Up
from splatnode.recon.result.whole import JoinedMap, MapSet, group_edges, walk_edges

_MOST_SIGMA = 1.0  # of the logarithm of a scale: beyond, nothing is known of it


@dataclass(frozen=True)
class _Sigmas:
    """Standard deviations, to the first scene: of the logarithm of the scale, and of the rotation."""

    scale: float
    deg: float

    def add_link(self, scale: float, deg: float) -> _Sigmas:
        return _Sigmas(math.hypot(self.scale, scale), math.hypot(self.deg, deg))


def scale_and_up(whole: MapSet, of: JoinedMap, scenes: Sequence[str]) -> tuple[Scale, Up | None]:
    """Combines scale and up of a map of these scenes: what is said of all holds for the one that is known worst.

    The world and the unit are those of the scene that the map is named after. Raises SceneFileError, OSError.
    """
    place = whole.places.get(of.name)
    if place is None or place.folder is None:
        return Scale(), None
    scale, up = StoredResult.create_from_path(place.folder).scale(), read_up(place.folder)
    further = [each for each in scenes if each != of.name]
    if not further:
        return scale, up
    worst = _find_largest_sigmas(whole, of.name, further)
    return _combine_scales(scale, worst, of.name, len(further)), up and _combine_up(up, worst, of.name)


def _find_largest_sigmas(whole: MapSet, first: str, further: Sequence[str]) -> _Sigmas | None:
    """The largest of all further scenes; None where it is not known of one of them."""
    known = {first: _Sigmas(0.0, 0.0)}
    for here, there, link in walk_edges(first, group_edges(whole.links)):
        if here in known and link.sigma_scale is not None and link.sigma_deg is not None:
            known[there] = known[here].add_link(link.sigma_scale, link.sigma_deg)
    if not all(each in known for each in further):
        return None
    return _Sigmas(max(known[each].scale for each in further), max(known[each].deg for each in further))


def _combine_scales(scale: Scale, worst: _Sigmas | None, first: str, further: int) -> Scale:
    if not scale.metric:
        return scale
    scenes = "a further scene hangs" if further == 1 else f"{further} further scenes hang"
    told = f"{scale.source or 'metres'}, in {first}; {scenes} on it by links, "
    if scale.interval_95 is None or worst is None or worst.scale > _MOST_SIGMA:
        return _set_source(
            replace(scale, interval_95=None), f"{told}and how well the metres are known there is not told"
        )
    low, high = scale.interval_95
    of_links = TWO_SIDED_95 * worst.scale
    wider = math.exp(-math.hypot(math.log(low), of_links)), math.exp(math.hypot(math.log(high), of_links))
    told += f"known to {format_rounded_up(100 * (wider[1] - 1.0))} % in all"
    return _set_source(replace(scale, interval_95=wider), told)


def _set_source(scale: Scale, source: str) -> Scale:
    """Sets the source, unless it is longer than files may have it."""
    return replace(scale, source=source) if len(source) <= LONGEST_TEXT else scale


def _combine_up(up: Up, worst: _Sigmas | None, first: str) -> Up:
    sigma_deg = up.sigma_deg if worst is None else min(math.hypot(up.sigma_deg, worst.deg), 180.0)
    return replace(up, source=f"{up.source}, in {first}", sigma_deg=sigma_deg)
