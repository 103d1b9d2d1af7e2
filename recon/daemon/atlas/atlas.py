"""All scenes of a node that are judged. Each is compared with those before it then: did the camera come back?"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.capture.process.logs import event
from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.core import give_back_memory
from splatnode.recon.daemon.atlas.bridge import LoopSide, VerifiedLoop, verify_loop
from splatnode.recon.daemon.atlas.links import EdgeKind, PoseGraphEdge, make_loop_edge
from splatnode.recon.daemon.atlas.recognition import (
    Codes,
    DescriptorsRecord,
    centre_descriptors,
    compute_global_descriptors,
    compute_mean_descriptor,
    make_descriptors_message,
    parse_descriptors,
    rank_similar_scenes,
)
from splatnode.recon.daemon.checkpoint import checkpoint, left, made_anew
from splatnode.recon.daemon.checkpoint.ledger import CheckpointError
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.places import SubmapIndex
from splatnode.recon.matching.match import Matcher
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.preparation import load_prior

log = logging.getLogger(__name__)

TRIED = 4  # scenes that are compared thoroughly with a new one: those that look most like it
MOST_LOOPS = 2  # of a new scene
NEAR = 2  # links of a chain: scenes so near have much in common, and a loop between them says little


class LoopDetector:
    def __init__(self, directory: Path, config: ReconstructionConfig, places: SubmapIndex) -> None:
        """`directory` is that of the checkpoint which has left/ and finished/ in it, `config` how scenes are made."""
        self._directory, self._config, self._places = directory, config, places
        self._matcher: Matcher | None = None
        self._codes: dict[str, Codes] = {}
        for folder in (*left.list_finished_folders(directory), *left.list_left_folders(directory)):
            try:
                found = made_anew.load(folder, "codes", DescriptorsRecord)
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

    def detect_loops(self, scene: str, graph: ViewGraph, pause: Callable[[], None]) -> Codes:
        """Links a scene that is judged with those before it that show the same; returns the codes of its images.

        What `pause` raises ends the work. Raises ResultWriteError.
        """
        if self._matcher is None:
            self._matcher = load_prior(self._config).matcher
        codes = {**self._codes, scene: compute_global_descriptors(graph.keyframes)}
        common, near = compute_mean_descriptor(codes), _find_neighbours(scene, self._places.links)
        mine = LoopSide(scene, graph, self._places.load_cameras(scene), centre_descriptors(codes[scene], common))
        loops: list[PoseGraphEdge] = []
        for other in [each for each in rank_similar_scenes(scene, codes) if each not in near][:TRIED]:
            pause()
            link = self._close_loop(other, mine, common, pause)
            give_back_memory()
            loops += [] if link is None else [link]
            if len(loops) == MOST_LOOPS:
                break
        self._places.add_loops(scene, loops)
        return codes[scene]

    def _load_graph(self, scene: str) -> ViewGraph:
        """Loads the view graph of a verified scene; an empty one where it cannot be read."""
        folder = left.find_folder(self._directory, scene)
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
        self, other: str, mine: LoopSide, common: npt.NDArray[np.float32], pause: Callable[[], None]
    ) -> PoseGraphEdge | None:
        graph, codes = self._load_graph(other), self._codes.get(other)
        if codes is None or len(graph.keyframes) != len(codes):
            return None  # something of it is damaged
        theirs = LoopSide(other, graph, self._places.load_cameras(other), centre_descriptors(codes, common))
        found, link = verify_loop(theirs, mine, self._config, self._matcher, pause), None
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
