"""Sets of images that no camera took which moved through a place: stereo halves, 360 degrees, a turntable.

Each is recognised by what only it shows, so that its advice fits. Stereo and 360-degree images are told by their pixels
and features before any pose is sought: no pinhole took them. A turntable is told by its matches, and only where there
is no scene: before a plain background its photographs are those of a camera that goes around the thing, and are used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.keyframes import PLAIN, Keyframe, longer_side
from splatnode.recon.matching import features, pair_matching
from splatnode.recon.matching.view_graph import Pair, ViewGraph
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification import Refusal, refuse

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MAX_OTHERS_RATIO = 0.2  # of the images of a set, that may not be stereo images beside those that are

STEREO_FEATURES = 1500  # of each half, the strongest, that are matched with the other half's
MAX_VERTICAL = 0.015  # of the height of a half: rows of rectified halves agree
MAX_DISPARITY = 0.15  # of the width of a half
# Of the two halves, in one image. Measured: 800 and .98 in stereo images, at most 25 and .23 in 19 other sets.
MIN_STEREO_MATCHES, MIN_STEREO_RATIO = 60, 0.5
MIN_STEREO_CELLS = 0.35  # of the cells of a half that has features, in which such matches lie
STEREO_CELLS = 6  # of a half, in both directions

PANORAMA_ASPECT, ASPECT_TOLERANCE = 2.0, 0.01  # width over height of an equirectangular image; relative
# Correlation of the first and the last column. Measured: .9 in the median of 360-degree images, at most .49 in 1143
# pieces of that shape of other photographs.
MIN_SEAM_CORRELATION = 0.65
SEAM_SIZE = 512, 256  # width and height at which the seam is looked at, pixels
MIN_SEAM_CONTRAST = 2.0  # standard deviation of a column without its slow changes, grey levels; else it tells nothing
MIN_SEAM_RATIO = 0.5  # of the images, whose seams say something

STATIC_PX = 1.0  # motion below which a match stands still, pixels at REFERENCE_SIDE
STATIC_GRID = 12, 8  # cells across and down by which it is told where matches stand still
MIN_STATIC_MATCHES = 60  # of a pair. Measured: 2900 before a static background, at most 43 in a set that is none
MIN_STATIC_RATIO = 0.25  # of all matches of a pair: texts that are laid over a film have fewer
MIN_STATIC_CELLS = 0.15  # of the picture
MIN_SIDE_CELLS = 0.5  # of the middle half of a quarter along one side, to count that side as standing still
MIN_STATIC_SIDES = 3  # a robot sees itself at one side, or at two
MIN_STATIC_PAIRS_RATIO = 0.8  # of the pairs: all of them share the background, however far the thing turned

STEREO = Refusal(
    Code.STEREO_IMAGES,
    "{count} of {of} images show the same place twice, {layout}: they are stereo images.",
    "Cut each image into its two halves and give the left ones ({first} of an image). With the others by --stereo and "
    "--stereo-baseline lengths are in metres, too. How to cut them: docs/inputs.md.",
)
PANORAMAS = Refusal(
    Code.PANORAMA,
    "{count} of {of} images are 360-degree ones: twice as wide as high, and the right edge goes on at the left.",
    "Cut each image into perspective views and give those, some of which look in each direction. How: docs/inputs.md.",
)
TURNTABLE = Refusal(
    Code.TURNTABLE,
    "The camera stood still: {static} of {of} pairs of photographs share a background that does not move. What differs "
    "turned or moved before it, as on a turntable.",
    "Hide the background by masks (--masks) or by a plain cloth behind and under the thing, or move the camera around "
    "the thing instead of turning it.",
)


@dataclass(frozen=True)
class StereoLayout:
    """How the two halves of a stereo image lie."""

    name: str
    axis: int  # along which they lie beside each other: 0 across, 1 down
    left: str  # the half that the left eye sees


SIDE_BY_SIDE, TOP_AND_BOTTOM = (
    StereoLayout("side by side", 0, "the left half"),
    StereoLayout("one above the other", 1, "the upper half"),
)


def measure_stereo(keyframe: Keyframe, layout: StereoLayout) -> tuple[int, float, float]:
    """How many matches of the two halves lie in the same place of both, their share of all, and of the cells."""
    size = np.array([keyframe.frame.width, keyframe.frame.height], float)
    half = size.copy()
    half[layout.axis] /= 2
    plain = keyframe.features.select_tilt(PLAIN)
    points = plain.points[plain.point_of]
    second = points[:, layout.axis] >= half[layout.axis]
    (firsts,), (seconds,) = np.nonzero(~second), np.nonzero(second)
    firsts, seconds = firsts[:STEREO_FEATURES], seconds[:STEREO_FEATURES]
    found = features.match(plain.descriptors[firsts], plain.descriptors[seconds], features.NearestNeighbourConfig())
    if not len(found):
        return 0, 0.0, 0.0
    first, other = points[firsts[found[:, 0]]], points[seconds[found[:, 1]]]
    other = other - half * (np.arange(2) == layout.axis)
    apart = np.abs(other - first) / half
    agree = (apart[:, 0] < MAX_DISPARITY) & (apart[:, 1] < MAX_VERTICAL)
    cells = _mark_occupied_cells(first[agree], half, (STEREO_CELLS, STEREO_CELLS))
    filled = _mark_occupied_cells(points[firsts], half, (STEREO_CELLS, STEREO_CELLS))
    return int(agree.sum()), float(agree.mean()), float(cells.sum() / max(1, filled.sum()))


def measure_seam(image: npt.NDArray[np.uint8]) -> float | None:
    """The correlation of the first and the last column of an image (H, W, 3), without what changes slowly along them.

    None where a column is too flat to tell anything. The poles, an eighth of the rows each, do not count.
    """
    grey = cv2.cvtColor(cv2.resize(image, SEAM_SIZE, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    columns = grey[:, [0, -1]].astype(np.float32)
    height = len(columns)
    detail = (columns - cv2.blur(columns, (1, 2 * (height // 16) + 1)))[height // 8 : -(height // 8)]
    contrast = detail.std(0)
    if contrast.min() < MIN_SEAM_CONTRAST:
        return None
    return float(detail.prod(1).mean() / contrast.prod())


@dataclass(frozen=True)
class StaticPair:
    """The matches that stand still in two images."""

    matches: int  # that stand still
    ratio: float  # of all matches
    cells: float  # share of the picture's cells in which matches stand still
    sides: int  # of the picture, along which they do

    @property
    def has_static_background(self) -> bool:
        """Whether the camera stood still: what surrounds the middle of the picture did not move."""
        many = self.matches >= MIN_STATIC_MATCHES and self.ratio >= MIN_STATIC_RATIO
        return many and self.cells >= MIN_STATIC_CELLS and self.sides >= MIN_STATIC_SIDES


def measure_static(graph: ViewGraph, pair: Pair) -> StaticPair:
    """Measures the matches that stand still in a pair, a key of `graph.plain`."""
    first, second = (graph.keyframes[index] for index in pair)
    matches, side = graph.plain[pair].matches, longer_side(second.frame)
    size = np.array([first.frame.width, first.frame.height], float)
    points1, points2 = first.features.points[matches[:, 0]], second.features.points[matches[:, 1]]
    still = pair_matching.motion_px(points1, points2, side) < STATIC_PX
    cells = _mark_occupied_cells(points1[still], size, STATIC_GRID)
    across, down = (count // 4 for count in STATIC_GRID)
    middle = cells[across:-across], cells[:, down:-down]
    strips = middle[0][:, :down], middle[0][:, -down:], middle[1][:across], middle[1][-across:]
    sides = [bool(strip.mean() >= MIN_SIDE_CELLS) for strip in strips]
    ratio = float(still.mean()) if len(still) else 0.0
    return StaticPair(int(still.sum()), ratio, float(cells.mean()), sum(sides))


def refuse_stereo_or_panorama(keyframes: Sequence[Keyframe]) -> Verdict | None:
    """Why images are none of a pinhole camera, or None."""
    return _refuse_panoramas(keyframes) or _refuse_stereo(keyframes)


def _refuse_panoramas(keyframes: Sequence[Keyframe]) -> Verdict | None:
    aspects = [keyframe.frame.width / keyframe.frame.height for keyframe in keyframes]
    if not keyframes or any(abs(aspect / PANORAMA_ASPECT - 1.0) > ASPECT_TOLERANCE for aspect in aspects):
        return None
    seams = [found for keyframe in keyframes if (found := measure_seam(keyframe.image)) is not None]
    if len(seams) < MIN_SEAM_RATIO * len(keyframes) or np.median(seams) < MIN_SEAM_CORRELATION:
        return None
    names = [keyframe.name for keyframe in keyframes]
    return refuse(PANORAMAS, names, count=len(names), of=len(names))


def _refuse_stereo(keyframes: Sequence[Keyframe]) -> Verdict | None:
    """Images are looked at one after the other, until too many are none: of other sets it takes a few of them."""
    for layout in (SIDE_BY_SIDE, TOP_AND_BOTTOM):
        most_others = int(MAX_OTHERS_RATIO * len(keyframes))
        found, others = [], 0
        for keyframe in keyframes:
            if _is_stereo(keyframe, layout):
                found.append(keyframe.name)
            else:
                others += 1
            if others > most_others:
                break
        else:
            if found:
                of, layout_name = len(keyframes), layout.name
                return refuse(STEREO, found, count=len(found), of=of, layout=layout_name, first=layout.left)
    return None


def _is_stereo(keyframe: Keyframe, layout: StereoLayout) -> bool:
    matches, ratio, cells = measure_stereo(keyframe, layout)
    return matches >= MIN_STEREO_MATCHES and ratio >= MIN_STEREO_RATIO and cells >= MIN_STEREO_CELLS


def explain_refusal(verdict: Verdict, graph: ViewGraph) -> Verdict:
    """The verdict; where there is no scene because something turned before a camera that stood still: that one.

    Copies of one photograph were left out before: those that are left differ by something that moved.
    """
    if verdict.publishable or verdict.code is Code.STATIC_CAMERA or not graph.plain:
        return verdict
    pairs = [measure_static(graph, pair) for pair in sorted(graph.plain)]
    static = sum(pair.has_static_background for pair in pairs)
    if static < MIN_STATIC_PAIRS_RATIO * len(pairs):
        return verdict
    return refuse(TURNTABLE, graph.names, static=static, of=len(pairs))


def _mark_occupied_cells(points: Array, size: Array, shape: tuple[int, int]) -> Mask:
    """(shape) the cells of an image of this (width, height) in which points (M, 2) lie."""
    cells = np.zeros(shape, bool)
    columns, rows = np.clip((points / size * shape).astype(int), 0, np.array(shape) - 1).T
    cells[columns, rows] = True
    return cells
