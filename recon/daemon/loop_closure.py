"""All scenes of a node that are judged. Each is compared with those before it then: did the camera come back?"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.messaging.messages import Message
from splatnode.capture.process.system import raise_shortage
from splatnode.capture.process.terminal import event
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.core import give_back_memory
from splatnode.recon.daemon import checkpoint, ledger
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.ledger import CheckpointError
from splatnode.recon.daemon.pose_graph import EdgeKind, PoseGraphEdge, make_loop_edge
from splatnode.recon.daemon.submap_index import SubmapIndex
from splatnode.recon.estimation import estimate_cameras, load_prior
from splatnode.recon.keyframes import Keyframe, longer_side
from splatnode.recon.matching import pair_matching
from splatnode.recon.matching.features import compute_global_descriptor
from splatnode.recon.matching.view_graph import Matcher, ViewGraph, match_pending
from splatnode.recon.result.verdict import Code
from splatnode.recon.threads import BACKGROUND, RunContext

# Do two scenes show one place? A few photographs of both are estimated together, as the photographs of one scene are.
#
# The bridge is taken only where that estimate may be published, and where it has the cameras of either scene as that
# scene has them. So a link between two scenes passes what a scene passes: two-view verification, the check of
# appearance, the evidence of all views; and the neighbours of the photographs that match have their say.

Array = npt.NDArray[np.float64]
Pair = tuple[int, int]

GLANCED = 8  # pairs of photographs, those with codes most alike, matched at a glance for each that is verified
VERIFIED = 6  # pairs, by their matches at a glance, that are matched and verified
MIN_VERIFIED = 2  # of these that show the same, of different photographs in both scenes
VIEWS = (5, 7)  # of each scene that are estimated together; all their pairs are matched. More, where that may help
TWIN_PX = 2.0  # median motion of a pair's matches, pixels at REFERENCE_SIDE, below which both have the same camera
MIN_COMMON = 100  # matches of a photograph with one that is among them already
MIN_VIEWS = 3  # of each scene that must have a camera then


@dataclass(frozen=True, eq=False)
class LoopSide:
    """One of the two scenes."""

    scene_id: str
    graph: ViewGraph
    cameras: Mapping[str, Array]  # T_world_camera (4, 4) of those keyframes that have one, by name
    codes: npt.NDArray[np.floating]  # (N, C) of the keyframes' images, of unit length once what all share is taken out


@dataclass(frozen=True, eq=False)
class VerifiedLoop:
    """Cameras T_world_camera (4, 4) of photographs of both scenes, in one world, by the photographs' names."""

    one: Mapping[str, Array]
    other: Mapping[str, Array]
    verified: int  # pairs of photographs, one of each scene, that show the same

    @property
    def why(self) -> str:
        photographs = f"{len(self.one)} + {len(self.other)} photographs of both are one scene"
        return f"{self.verified} pairs of photographs show the same, and {photographs}"


@dataclass(frozen=True)
class _LoopRejection:
    """There is no bridge by some photographs of both scenes."""

    why: str
    joined: bool  # whether photographs of both had cameras in one world: more photographs may make a bridge of that


def verify_loop(
    one: LoopSide,
    other: LoopSide,
    config: ReconstructionConfig,
    matcher: Matcher | None,
    run: RunContext = BACKGROUND,
) -> VerifiedLoop | str:
    """The bridge between the scenes, or why there is none. It pauses about once a second, which may raise."""
    pairs = verify_pairs(one, other, config, run)
    if len(_select_distinct_pairs(pairs)) < MIN_VERIFIED:
        return f"{len(pairs)} pairs of photographs show the same"
    why = ""
    for most in VIEWS:
        found = _verify_with_views(one, other, pairs, most, config, matcher, run)
        if isinstance(found, VerifiedLoop):
            return found
        why = found.why
        if not found.joined:
            break
    return why


def _verify_with_views(
    one: LoopSide,
    other: LoopSide,
    pairs: Sequence[Pair],
    most: int,
    config: ReconstructionConfig,
    matcher: Matcher | None,
    run: RunContext,
) -> VerifiedLoop | _LoopRejection:
    """Verifies the loop with `most` images of each scene."""
    chosen = [select_views(side, [pair[end] for pair in pairs], most) for end, side in enumerate((one, other))]
    graph = ViewGraph(config.matching)
    for side, views in zip((one, other), chosen, strict=True):
        graph = graph.merge(_prefix_names(side, views))
    for whole in match_pending(graph, matcher):
        graph = whole
        run.pause()
    twins = _find_twins(graph, one.scene_id)
    estimate = estimate_cameras(graph.remove_keyframes(twins.keys()), (), config, run)
    names, cameras = estimate.graph.names, estimate.registration.cameras if estimate.registration else ()
    found = {names[camera.index]: camera.T_world_camera for camera in cameras}
    found |= {name: found[twin] for name, twin in twins.items() if twin in found}
    mine, theirs = (_select_cameras(side.scene_id, found) for side in (one, other))
    fewest = min(len(mine), len(theirs))
    joined = fewest >= MIN_VIEWS or (fewest > 0 and estimate.verdict.code is not Code.SPLIT)
    if not estimate.publishable:
        return _LoopRejection(f"together they are {estimate.verdict.code.value}: {estimate.verdict.message}", joined)
    if fewest < MIN_VIEWS:
        return _LoopRejection(f"together only {len(mine)} and {len(theirs)} of their photographs have cameras", joined)
    return VerifiedLoop(mine, theirs, len(pairs))


def verify_pairs(one: LoopSide, other: LoopSide, config: ReconstructionConfig, run: RunContext) -> list[Pair]:
    """The pairs, a keyframe of each scene by its position, that show the same; those with most matches first."""
    alike = one.codes @ other.codes.T
    order = np.argsort(-alike, axis=None, kind="stable")[: GLANCED * VERIFIED]
    likely = [tuple(int(index) for index in np.unravel_index(each, alike.shape)) for each in order]

    def both(pair: tuple[int, ...]) -> tuple[Keyframe, Keyframe]:
        return one.graph.keyframes[pair[0]], other.graph.keyframes[pair[1]]

    matching, glance_features = config.matching.pair_matching, config.matching.candidates.glance_features
    glanced = {}
    for pair in likely:
        glanced[pair] = pair_matching.glance(*both(pair), glance_features, matching)
        run.pause()
    found: dict[Pair, int] = {}
    for pair in sorted(glanced, key=lambda pair: -glanced[pair])[:VERIFIED]:
        geometry = pair_matching.match_plain(*both(pair), matching).geometry
        if geometry is not None:
            found[pair[0], pair[1]] = len(geometry.matches)
        run.pause()
    return sorted(found, key=lambda pair: -found[pair])


def _select_distinct_pairs(pairs: Sequence[Pair]) -> list[Pair]:
    """Pairs that have no keyframe in common, the first ones first."""
    taken: tuple[set[int], set[int]] = set(), set()
    distinct = []
    for pair in pairs:
        if pair[0] not in taken[0] and pair[1] not in taken[1]:
            distinct.append(pair)
            taken[0].add(pair[0])
            taken[1].add(pair[1])
    return distinct


def _find_twins(graph: ViewGraph, scene_id: str) -> dict[str, str]:
    """Photographs that were taken from where one of scene `scene_id` was, with the name of that one.

    They have no parallax to each other, so one camera is estimated for both.
    """
    twins: dict[str, str] = {}
    for (i, j), pair in sorted(graph.pairs.items()):
        one, other = graph.keyframes[i], graph.keyframes[j]
        moved_px = pair_matching.median_motion_px(pair, longer_side(one.frame), longer_side(other.frame))
        first, second = sorted((one.name, other.name), key=lambda name: not _belongs_to(scene_id, name))
        if _belongs_to(scene_id, first) and not _belongs_to(scene_id, second) and moved_px < TWIN_PX:
            twins.setdefault(second, first)
    return twins


def select_views(side: LoopSide, matched: Sequence[int], most: int) -> list[int]:
    """At most so many keyframes with a camera: two of those `matched`, then such as have enough in common with these.

    Each is as far as can be from those before it: cameras close together say little about scale and position.
    """
    centres = {index: side.cameras[name][:3, 3] for index, name in enumerate(side.graph.names) if name in side.cameras}
    chosen: list[int] = []

    def farthest(among: Collection[int]) -> int:
        return max(among, key=lambda index: (_distance(centres[index], [centres[each] for each in chosen]), -index))

    first = [index for index in dict.fromkeys(matched) if index in centres]
    chosen += first[:1]
    if len(first) > 1:
        chosen.append(farthest(first[1:]))
    while 0 < len(chosen) < most:
        common = {index: max(side.graph.partners(each).get(index, 0) for each in chosen) for index in centres}
        rest = {index: count for index, count in common.items() if index not in chosen}
        near = [index for index, count in rest.items() if count >= MIN_COMMON]
        if not rest:
            break
        chosen.append(farthest(near) if near else max(rest, key=lambda index: (rest[index], -index)))
    return chosen


def _distance(centre: Array, others: Sequence[Array]) -> float:
    return min(float(np.linalg.norm(centre - each)) for each in others)


def _prefix_names(side: LoopSide, views: Collection[int]) -> ViewGraph:
    """The view graph of these keyframes alone, by names that no keyframe of another scene has."""
    gone = {name for index, name in enumerate(side.graph.names) if index not in views}
    graph = side.graph.remove_keyframes(gone)
    keyframes = (
        replace(each, frame=replace(each.frame, name=f"{side.scene_id}/{each.name}")) for each in graph.keyframes
    )
    return replace(graph, keyframes=tuple(keyframes), codes={}, glanced={})


def _belongs_to(scene_id: str, name: str) -> bool:
    return name.startswith(f"{scene_id}/")


def _select_cameras(scene_id: str, cameras: Mapping[str, Array]) -> dict[str, Array]:
    return {name.removeprefix(f"{scene_id}/"): T for name, T in cameras.items() if _belongs_to(scene_id, name)}


# Which of the finished scenes look like a new one? By the codes of their images; that is verified afterwards.

Codes = npt.NDArray[np.float16]  # (N, C) of N images, each of unit length

BEST = 3  # of the pairs of images by which two scenes are compared
_MIN_NORM = 1e-9


class DescriptorsRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """In a checkpoint. The only array holds the codes, a row each."""

    names: list[str]  # of the keyframes


def compute_global_descriptors(keyframes: Sequence[Keyframe]) -> Codes:
    return np.stack([compute_global_descriptor(keyframe.features) for keyframe in keyframes]).astype(np.float16)


def make_descriptors_message(
    keyframes: Sequence[Keyframe], codes: Codes
) -> tuple[DescriptorsRecord, list[npt.NDArray]]:
    return DescriptorsRecord([keyframe.name for keyframe in keyframes]), [codes.view(np.uint16)]


def parse_descriptors(message: Message[DescriptorsRecord]) -> Codes:
    """Parses the message of `make_descriptors_message`. Raises ValueError where another version wrote it."""
    if len(message.arrays) != 1 or len(message.arrays[0]) != len(message.header.names):
        raise ValueError("codes of another version")
    return np.array(message.arrays[0]).view(np.float16)


def compute_mean_descriptor(codes: Mapping[str, Codes]) -> npt.NDArray[np.float32]:
    """(C,) what the images of all scenes have in common: it tells none from another."""
    total = sum(each.sum(0, dtype=np.float32) for each in codes.values())
    return np.asarray(total / max(1, sum(map(len, codes.values()))), np.float32)


def centre_descriptors(codes: Codes, common: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """(N, C) without what all have in common, of unit length again: their products are cosines."""
    rest = codes.astype(np.float32) - common
    return rest / np.maximum(np.linalg.norm(rest, axis=1, keepdims=True), _MIN_NORM)


def rank_similar_scenes(scene: str, codes: Mapping[str, Codes]) -> list[str]:
    """The other scenes, that which looks most like `scene` first: by their BEST pairs of images."""
    common = compute_mean_descriptor(codes)
    mine = centre_descriptors(codes[scene], common)
    likeness = {}
    for other, theirs in codes.items():
        if other != scene:
            alike = (mine @ centre_descriptors(theirs, common).T).max(1)
            likeness[other] = float(np.sort(alike)[-BEST:].mean())
    return sorted(likeness, key=lambda other: (-likeness[other], other))


log = logging.getLogger(__name__)

TRIED = 4  # scenes that are compared thoroughly with a new one: those that look most like it
MOST_LOOPS = 2  # of a new scene
NEAR = 2  # links of a chain: scenes so near have much in common, and a loop between them says little


class LoopDetector:
    def __init__(self, directory: Path, config: ReconstructionConfig, index: SubmapIndex) -> None:
        """`directory` is that of the checkpoint which has left/ and finished/ in it, `config` how scenes are made."""
        self._directory, self._config, self._index = directory, config, index
        self._matcher: Matcher | None = None
        self._codes: dict[str, Codes] = {}
        for folder in (*ledger.list_finished_folders(directory), *ledger.list_left_folders(directory)):
            try:
                found = ledger.load(folder, "codes", DescriptorsRecord)
                self._codes |= {} if found is None else {folder.name: parse_descriptors(found)}
            except ValueError as error:
                log.warning("%s is not recognised again: %s", folder.name, error)

    def has_scene(self, scene: str) -> bool:
        """Whether the scene was compared with others, and is recognised."""
        return scene in self._codes

    def add_scene(self, store: Store, graph: ViewGraph, codes: Codes) -> None:
        """Writes into the checkpoint of a scene that is judged what it is recognised by later: `codes` of its images.

        Raises OSError.
        """
        store.save("codes", *make_descriptors_message(graph.keyframes, codes))
        self._codes[store.scene_id] = codes

    def remove_scene(self, scene: str) -> None:
        """The scene is not judged any more."""
        self._codes.pop(scene, None)

    def detect_loops(self, scene: str, graph: ViewGraph, run: RunContext) -> Codes:
        """Links a scene that is judged with those before it that show the same; returns the codes of its images.

        What a pause raises ends the work. Raises ResultWriteError.
        """
        if self._matcher is None:
            self._matcher = load_prior(self._config).matcher
        codes = {**self._codes, scene: compute_global_descriptors(graph.keyframes)}
        common, near = compute_mean_descriptor(codes), _find_neighbours(scene, self._index.links)
        mine = LoopSide(scene, graph, self._index.load_cameras(scene), centre_descriptors(codes[scene], common))
        loops: list[PoseGraphEdge] = []
        for other in [each for each in rank_similar_scenes(scene, codes) if each not in near][:TRIED]:
            run.pause()
            link = self._close_loop(other, mine, common, run)
            give_back_memory()
            loops += [] if link is None else [link]
            if len(loops) == MOST_LOOPS:
                break
        self._index.add_loops(scene, loops)
        return codes[scene]

    def _load_graph(self, scene: str) -> ViewGraph:
        """Loads the view graph of a verified scene; an empty one where it cannot be read."""
        folder = ledger.find_folder(self._directory, scene)
        if folder.exists():
            try:
                with contextlib.closing(Store(folder)) as store:
                    return checkpoint.load_graph(store, self._config)
            except (CheckpointError, OSError, ValueError) as error:
                raise_shortage(error)
                log.warning("%s is not recognised again: %s", scene, error)
                self.remove_scene(scene)
        return ViewGraph(self._config.matching)

    def _close_loop(
        self, other: str, mine: LoopSide, common: npt.NDArray[np.float32], run: RunContext
    ) -> PoseGraphEdge | None:
        graph, codes = self._load_graph(other), self._codes.get(other)
        if codes is None or len(graph.keyframes) != len(codes):
            return None  # something of it is damaged
        theirs = LoopSide(other, graph, self._index.load_cameras(other), centre_descriptors(codes, common))
        found, link = verify_loop(theirs, mine, self._config, self._matcher, run), None
        if isinstance(found, VerifiedLoop):
            ends = found.one, found.other
            link = make_loop_edge(other, mine.scene_id, theirs.cameras, mine.cameras, ends, found.why)
        why = found if isinstance(found, str) else "together, their cameras lie otherwise" if link is None else link.why
        event(log, logging.INFO, "no_loop" if link is None else "loop", scene=mine.scene_id, other=other, why=why)
        return link


def _find_neighbours(scene: str, links: tuple[PoseGraphEdge, ...]) -> set[str]:
    """The scene, and those that at most NEAR links of its chain lead to."""
    near = {scene}
    for _ in range(NEAR):
        ends = [(each.scene, each.other) for each in links if each.kind is EdgeKind.CHAIN]
        near |= {end for pair in ends if not near.isdisjoint(pair) for end in pair}
    return near
