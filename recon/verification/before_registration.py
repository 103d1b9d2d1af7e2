"""What frames and their pairs say by themselves: why there can be no poses, or why none were found."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from splatnode.recon.frames.keyframe import longer_side
from splatnode.recon.frames.screening import Rejected
from splatnode.recon.matching.pair_matching import median_motion_px
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.registration import Registration
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification import refit, rejections
from splatnode.recon.verification.config import DecisionConfig
from splatnode.recon.verification.input_kinds import refuse_stereo_or_panorama
from splatnode.recon.verification.rejections import refuse

Pair = tuple[int, int]


def refuse_before_registration(
    graph: ViewGraph, rejected: Sequence[Rejected], config: DecisionConfig
) -> Verdict | None:
    """Why there can be no scene whatever the poses are, or None. `rejected` are the frames that screening left out."""
    kind = refuse_stereo_or_panorama(graph.keyframes)
    return kind or _refuse_insufficient_images(graph, rejected, config) or _refuse_no_motion(graph, config)


def refuse_unplaced(graph: ViewGraph, registration: Registration | None, config: DecisionConfig) -> Verdict:
    """Why registration placed too few cameras to verify them."""
    names = [keyframe.name for keyframe in graph.keyframes]
    doubted = _refuse_doubtful_focal(graph, config)
    if doubted is not None:
        return doubted
    components = graph.components()
    if len(components[0]) < config.min_cameras:
        found = f"Only {len(components[0])} of {len(names)} photographs overlap."
        return refuse(rejections.NO_OVERLAP, names, found=found)
    turned = _find_pure_rotations(graph)
    if 2 * len(turned) >= len(graph.pairs):
        return _refuse_pure_rotation(graph, turned)
    placed = 0 if registration is None else len(registration.cameras)
    found = f"Only {placed} of {len(names)} photographs could be placed with certainty."
    return refuse(rejections.NO_OVERLAP, names, found=found)


def _refuse_insufficient_images(
    graph: ViewGraph, rejected: Sequence[Rejected], config: DecisionConfig
) -> Verdict | None:
    names = [keyframe.name for keyframe in graph.keyframes]
    if len(names) < config.min_cameras:
        return _refuse_too_few_views(names, rejected, config)
    if graph.pairs:
        return None
    plain = [keyframe.name for keyframe in graph.keyframes if len(keyframe.features.points) < config.min_features]
    if len(plain) > len(names) / 2:
        return refuse(rejections.WITHOUT_TEXTURE, plain, plain=len(plain), count=len(names))
    return refuse(rejections.NO_OVERLAP, names, found="No two photographs show enough of the same things.")


def _refuse_too_few_views(names: list[str], rejected: Sequence[Rejected], config: DecisionConfig) -> Verdict:
    """Refuses with what most rejected frames have in common, if they would have been enough."""
    by_code = {code: [frame for frame in rejected if frame.code == code] for code in Code}
    copies, blurred, blank = (by_code[code] for code in (Code.STATIC_CAMERA, Code.BLUR, Code.LOW_TEXTURE))
    if len(names) + len(rejected) >= config.min_cameras or (copies and len(names) == 1):
        if copies and len(names) == 1 and not blurred and not blank:
            return refuse(rejections.ONLY_COPIES, [*names, *(frame.name for frame in copies)])
        if len(blurred) > max(len(copies), len(blank)):
            of_blurred = [frame.name for frame in blurred]
            reason = blurred[0].reason
            return refuse(rejections.ALL_BLURRED, of_blurred, count=len(blurred), first=of_blurred[0], reason=reason)
        if len(blank) > len(copies):
            of_blank = [frame.name for frame in blank]
            return refuse(rejections.WITHOUT_TEXTURE, of_blank, plain=len(blank), count=len(names) + len(rejected))
    usable = f"{len(names)} usable photograph{'s' if len(names) != 1 else ''}"
    left_out = f"; {len(rejected)} more were left out ({rejected[0].name}: {rejected[0].reason})" if rejected else ""
    return refuse(rejections.TOO_FEW, names, usable=usable, least=config.min_cameras, left_out=left_out)


def _refuse_no_motion(graph: ViewGraph, config: DecisionConfig) -> Verdict | None:
    """The camera stood still, or only turned."""
    still = [pair for pair, view in graph.pairs.items() if _motion_px(graph, pair, view) < config.static_px]
    if len(still) == len(graph.pairs):
        return refuse(rejections.ONLY_COPIES, _names(graph, still))
    turned = _find_pure_rotations(graph)
    return _refuse_pure_rotation(graph, turned) if len(turned) >= config.turned_share * len(graph.pairs) else None


def _refuse_doubtful_focal(graph: ViewGraph, config: DecisionConfig) -> Verdict | None:
    """A refusal if all frames were given one focal length, and their pairs vote for quite another."""
    given = {
        keyframe.frame.intrinsics.fx if keyframe.frame.intrinsics is not None else None for keyframe in graph.keyframes
    }
    told = given.pop() if len(given) == 1 else None
    voted = refit.vote_focal(graph.keyframes, list(graph.pairs.values()))
    if told is None or voted is None or abs(np.log(voted / told)) < config.voted_change:
        return None
    names = [keyframe.name for keyframe in graph.keyframes]
    change = 100 * (voted / told - 1.0)
    return refuse(rejections.WRONG_FOCAL_BY_VOTE, names, given=told, voted=voted, change=change)


def _find_pure_rotations(graph: ViewGraph) -> list[Pair]:
    return [pair for pair, view in graph.pairs.items() if view.is_pure_rotation]


def _refuse_pure_rotation(graph: ViewGraph, turned: list[Pair]) -> Verdict:
    found = f"{len(turned)} of {len(graph.pairs)} overlapping pairs show no parallax"
    return refuse(rejections.NO_PARALLAX, _names(graph, turned), found=found)


def _names(graph: ViewGraph, pairs: Iterable[Pair]) -> list[str]:
    return sorted({graph.keyframes[i].name for pair in pairs for i in pair})


def _motion_px(graph: ViewGraph, pair: Pair, view: TwoView) -> float:
    side1, side2 = (longer_side(graph.keyframes[index].frame) for index in pair)
    return median_motion_px(view, side1, side2)
