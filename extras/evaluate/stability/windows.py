"""Which windows of consecutive photographs are tried, and how far apart their views are."""

from __future__ import annotations

import enum
import logging
import pickle
import zlib
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.extras.evaluate.dataset import TrueCamera
from splatnode.extras.evaluate.report import Timing, find_largest_share, had_alone
from splatnode.extras.evaluate.stability.perturbations import TrialScene, classify_motion
from splatnode.extras.evaluate.stability.trial import (
    ROUGH,
    CameraError,
    has_only_right_cameras,
    measure_camera_errors,
    measure_set_errors,
)
from splatnode.recon.keyframes import PLAIN, Features, Keyframe
from splatnode.recon.matching.pair_matching import MatchedPair, TwoView
from splatnode.recon.matching.view_graph import Matcher, MatchingConfig, Pair, ViewGraph, match_pending
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.verdict import Verdict

logger = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]

COUNTS = (3, 6, 12)  # of photographs
STRIDES = (1, 2, 3, 4)
_PARALLEL = 1e-6  # smallest eigenvalue of the sum over axes of I - d d^T: below, the axes have no nearest point


@dataclass(frozen=True)
class Window:
    """Photographs of one scene, `stride` apart in the order of capture."""

    scene: str
    count: int
    stride: int
    start: int
    names: tuple[str, ...]
    angle_deg: float  # the largest over the views of the angle to the nearest other one


def select_moving_scenes(places: Sequence[TrialScene]) -> list[TrialScene]:
    """The places whose true cameras move; the others are named in the log: without motion no centre is wrong."""
    still = [place.name for place in places if classify_motion(place.Ts_world_camera) == "turned"]
    if still:
        logger.warning("no windows of %s: the true cameras do not move", ", ".join(still))
    return [place for place in places if place.name not in still]


def draw_windows(place: TrialScene, per_kind: int, seed: int, counts: Sequence[int] = COUNTS) -> list[Window]:
    """At most `per_kind` windows of each count and stride, drawn at random, in which the camera moves."""
    Ts, chosen = place.Ts_world_camera, []
    for count in counts:
        for stride in STRIDES:
            spans = {start: Ts[start : start + stride * count : stride] for start in range(len(Ts))}
            starts = [
                start for start, span in spans.items() if len(span) == count and classify_motion(span) != "turned"
            ]
            rng = np.random.default_rng([seed, zlib.crc32(f"{place.name} {count} {stride}".encode())])
            for start in sorted(rng.permutation(starts)[:per_kind].tolist()):
                names = place.names[start : start + stride * count : stride]
                chosen.append(Window(place.name, count, stride, start, tuple(names), compute_angle_deg(spans[start])))
    return chosen


def compute_angle_deg(Ts_world_camera: Array) -> float:
    """The largest over the views (C, 4, 4) of the angle to the nearest other view, seen from the middle of the scene.

    The middle is the point with the least squared distance to all optical axes. Where that is behind a camera, or the
    axes are parallel, nothing is known of it, and angles are those between the viewing directions. Only true cameras
    count, so that the angle is the same for every method.
    """
    rays = Ts_world_camera[:, :3, 2]
    middle = _find_nearest_to_axes(Ts_world_camera)
    if middle is not None:
        towards = middle - Ts_world_camera[:, :3, 3]
        if ((towards * rays).sum(1) > 0).all():
            rays = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    chords = np.linalg.norm(rays[:, None] - rays[None], axis=2)
    np.fill_diagonal(chords, 2.0)
    return float(np.degrees(2.0 * np.arcsin(np.minimum(chords.min(1) / 2.0, 1.0))).max())


def _find_nearest_to_axes(Ts_world_camera: Array) -> Array | None:
    directions, centres = Ts_world_camera[:, :3, 2], Ts_world_camera[:, :3, 3]
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]  # (C, 3, 3) projects off each axis
    total = across.sum(0)
    if np.linalg.eigvalsh(total)[0] < _PARALLEL:
        return None
    return np.linalg.solve(total, np.einsum("cij,cj->i", across, centres))


# One window and one method: the answer, compared with the truth.

OURS = "splatnode"  # among the methods
FAILED = "FAILED"
RowKey = tuple[str, int, int, int, str]


class WindowOutcome(enum.Enum):
    """The outcome of a window, by what was published: right is within 2 degrees and 5 % of the spread."""

    RIGHT = "right"  # all photographs are placed
    RIGHT_PART = "right_part"  # those that are placed
    BETWEEN = "between"  # not right, and within the claim; without one, within 5 degrees and 10 %
    WRONG = "wrong"  # a camera is beyond its claim: see claim.CameraError.wrong
    REFUSED = "refused"
    FAILED = "failed"  # no answer


@dataclass(frozen=True)
class WindowAnswer:
    """The answer of a method to a window."""

    verdict: Verdict | None  # None: there was no answer, `message` says why
    cameras: tuple[CameraEstimate, ...] = ()  # where nothing is published, those that were registered all the same
    seconds: float | None = None
    timed_on: Timing | None = None  # of `seconds`
    fresh_seconds: float | None = None
    fresh_on: Timing | None = None
    evidence: Mapping[str, object] | None = None
    message: str = ""


@dataclass(frozen=True, kw_only=True)
class WindowRow:
    """One line of windows.json. What was not measured is None."""

    scene: str
    count: int
    stride: int
    start: int
    names: tuple[str, ...]
    angle_deg: float  # the largest over the views of the angle to the nearest other one: see window.angle_deg
    method: str
    verdict: str  # a code; FAILED where there was no answer
    published: bool
    message: str
    seconds: float | None  # from matched pairs to the verdict, or to the model; None also: not alone
    fresh_seconds: float | None  # from photographs to the same, with nothing kept of other windows
    cameras: tuple[CameraError, ...]  # those published; of a refusal, those that were registered
    rotation_deg: float | None  # the largest error of any relative rotation
    centre_pct: float | None  # RMS error of the centres, in percent of the true ones' spread
    evidence: Mapping[str, Any] | None  # recon.verification.error_model.make_evidence_record
    cores: int | None = None  # that it could use
    processor: str | None = None
    others: float | None = None  # the share of the cores' time that others took meanwhile; None also: nobody can tell

    @property
    def key(self) -> RowKey:
        return self.scene, self.count, self.stride, self.start, self.method

    @property
    def right(self) -> bool:
        """Whether all cameras are right that there are, published or not."""
        return has_only_right_cameras(self.cameras)

    @property
    def whole(self) -> bool:
        """Whether every photograph has a camera."""
        return len(self.cameras) == self.count

    @property
    def outcome(self) -> WindowOutcome:
        if self.verdict == FAILED:
            return WindowOutcome.FAILED
        if not self.published:
            return WindowOutcome.REFUSED
        if not self.cameras or any(camera.is_wrong(self.verdict == ROUGH) for camera in self.cameras):
            return WindowOutcome.WRONG
        if self.right:
            return WindowOutcome.RIGHT if self.whole else WindowOutcome.RIGHT_PART
        return WindowOutcome.BETWEEN


def make_key(window: Window, method: str) -> RowKey:
    return window.scene, window.count, window.stride, window.start, method


def judge_window(window: Window, method: str, answer: WindowAnswer, truth: Mapping[str, TrueCamera]) -> WindowRow:
    """The answer against the true cameras of all photographs of the window."""
    whole = measure_set_errors(answer.cameras, truth)
    verdict, timed_on = answer.verdict, answer.timed_on
    others = find_largest_share((timed_on, answer.fresh_on))
    alone = had_alone(others)
    return WindowRow(
        scene=window.scene,
        count=window.count,
        stride=window.stride,
        start=window.start,
        names=window.names,
        angle_deg=window.angle_deg,
        method=method,
        verdict=FAILED if verdict is None else verdict.code.value,
        published=verdict is not None and verdict.publishable,
        message=answer.message if verdict is None else verdict.message,
        seconds=answer.seconds if alone else None,
        fresh_seconds=answer.fresh_seconds if alone else None,
        cameras=measure_camera_errors(answer.cameras, truth),
        rotation_deg=whole.rotation_pair_deg,
        centre_pct=whole.centre_pct,
        evidence=answer.evidence,
        cores=timed_on and timed_on.cores,
        processor=timed_on and timed_on.processor,
        others=others,
    )


# What was found in a scene, kept for its further windows: of one photograph or of two, whatever others there are.

PieceKey = tuple[str, ...]  # what was found; then the name of the photograph, or the names of both
Pieces = Mapping[PieceKey, bytes]  # each pickled: who keeps them need not know what they are

_PLAIN, _TILTED = "plain", "tilted"  # features of a photograph, or matches of two, in the order of content


def select_keys(keys: Collection[PieceKey], names: Collection[str]) -> list[PieceKey]:
    """Those of photographs that are all among `names`."""
    chosen = frozenset(names)
    return [key for key in keys if chosen.issuperset(key[1:])]


def load_plain_features(known: Pieces, name: str) -> Features | None:
    """Loads the plain features of an image; None where they are not known."""
    return _load_piece(known, (_PLAIN, name))


def match_keyframes(
    keyframes: Sequence[Keyframe], known: Pieces, config: MatchingConfig, matcher: Matcher | None
) -> tuple[ViewGraph, dict[PieceKey, bytes]]:
    """The complete view graph of `keyframes`, which have plain features, and what was found for it and not known.

    The graph is to the bit that which matching from scratch gives: which pairs tilted features are chosen for is asked
    anew. Where not all pairs are matched, which are depends on what was matched before: of pairs nothing is used then.
    """
    graph = ViewGraph(config)
    for keyframe in keyframes:
        graph = graph.add_keyframe(keyframe)
    found: dict[PieceKey, object] = {(_PLAIN, keyframe.name): keyframe.features for keyframe in keyframes}
    if len(keyframes) > config.candidates.exhaustive:
        graph = _take_last(match_pending(graph, matcher))
    else:
        graph = _match_plain_features(_restore_plain_matches(graph, known))
        found |= {(_PLAIN, *_list_names(graph, pair)): each for pair, each in graph.plain.items()}
        graph = _take_last(match_pending(graph if matcher else _restore_tilted_matches(graph, known), matcher))
        graph = replace(graph, tilted=_sort_pairs(graph.tilted))
    if matcher is None:  # else the features of its points are among them
        found |= {
            (_TILTED, each.name): each.features for each in graph.keyframes if (each.features.tilt != PLAIN).any()
        }
        found |= {(_TILTED, *_list_names(graph, pair)): each for pair, each in graph.tilted.items()}
    return graph, {key: pickle.dumps(piece) for key, piece in found.items() if key not in known}


def _match_plain_features(graph: ViewGraph) -> ViewGraph:
    """Matches all pairs by plain features alone, in the order of matching from scratch."""
    config = graph.config
    untilted = msgspec.structs.replace(config, tilting=msgspec.structs.replace(config.tilting, tilts=()))
    whole = _take_last(match_pending(replace(graph, config=untilted), None))
    return replace(whole, config=config, plain=_sort_pairs(whole.plain))


def _restore_plain_matches(graph: ViewGraph, known: Pieces) -> ViewGraph:
    """Restores the pairs that are known to be matched by plain features."""
    plain: dict[Pair, MatchedPair] = {}
    pairs: dict[Pair, TwoView] = {}
    done: set[Pair] = set()
    for pair in graph.pending:
        first, second = graph.sort_by_content(*pair)
        found = _load_piece(known, (_PLAIN, *_list_names(graph, (first, second))))
        if found is None:
            continue
        done.add(pair)
        plain[first, second] = found
        if found.geometry is not None:
            pairs[pair] = found.geometry if first < second else found.geometry.swap()
    return replace(graph, pairs=pairs, plain=plain, pending=graph.pending - done)


def _restore_tilted_matches(graph: ViewGraph, known: Pieces) -> ViewGraph:
    """Restores the weak pairs that are known to be matched by tilted features, and these features."""
    keyframes, tilted = list(graph.keyframes), dict(graph.tilted)
    for pair in sorted(graph.select_weak_pairs()):
        found = _load_piece(known, (_TILTED, *_list_names(graph, pair)))
        if found is None:
            continue
        tilted[pair] = found
        for index in pair:
            features = _load_piece(known, (_TILTED, keyframes[index].name))
            keyframes[index] = replace(keyframes[index], features=features)
    return replace(graph, keyframes=tuple(keyframes), tilted=tilted)


def _sort_pairs(pairs: Mapping[Pair, MatchedPair]) -> dict[Pair, MatchedPair]:
    """Sorts the pairs in the order of matching from scratch."""
    return dict(sorted(pairs.items(), key=lambda item: sorted(item[0])))


def _list_names(graph: ViewGraph, pair: Pair) -> tuple[str, str]:
    return graph.keyframes[pair[0]].name, graph.keyframes[pair[1]].name


def _load_piece(known: Pieces, key: PieceKey) -> Any:
    """None where it is not known."""
    return pickle.loads(known[key]) if key in known else None


def _take_last(graphs: Iterable[ViewGraph]) -> ViewGraph:
    (last,) = deque(graphs, maxlen=1)
    return last
