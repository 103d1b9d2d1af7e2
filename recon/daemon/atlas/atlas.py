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
from splatnode.recon.config import Config
from splatnode.recon.core import give_back_memory
from splatnode.recon.daemon.atlas.bridge import Bridge, Side, bridge
from splatnode.recon.daemon.atlas.links import Kind, Link, bridged
from splatnode.recon.daemon.atlas.recognition import (
    Codes,
    CodesRecord,
    centred,
    codes_from,
    codes_message,
    codes_of,
    in_common,
    likeliest,
)
from splatnode.recon.daemon.checkpoint import checkpoint, left, made_anew
from splatnode.recon.daemon.checkpoint.ledger import CheckpointError
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.places import Places
from splatnode.recon.matching.match import Matcher
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.preparation import load_prior

log = logging.getLogger(__name__)

TRIED = 4  # scenes that are compared thoroughly with a new one: those that look most like it
MOST_LOOPS = 2  # of a new scene
NEAR = 2  # links of a chain: scenes so near have much in common, and a loop between them says little


class Atlas:
    def __init__(self, directory: Path, config: Config, places: Places) -> None:
        """`directory` is that of the checkpoint which has left/ and finished/ in it, `config` how scenes are made."""
        self._directory, self._config, self._places = directory, config, places
        self._matcher: Matcher | None = None
        self._codes: dict[str, Codes] = {}
        for folder in (*left.finished(directory), *left.folders(directory)):
            try:
                found = made_anew.load(folder, "codes", CodesRecord)
                self._codes |= {} if found is None else {folder.name: codes_from(found)}
            except ValueError as error:
                log.warning("%s is not recognised again: %s", folder.name, error)

    def knows(self, scene: str) -> bool:
        """Whether the scene was compared with others, and is recognised."""
        return scene in self._codes

    def keep(self, store: Store, graph: ViewGraph, codes: Codes) -> None:
        """Writes into the checkpoint of a scene that is judged what it is recognised by later: `codes` of its images.

        Raises OSError.
        """
        store.save("codes", *codes_message(graph.keyframes, codes))
        self._codes[store.scene_id] = codes

    def forget(self, scene: str) -> None:
        """The scene is not judged any more."""
        self._codes.pop(scene, None)

    def compare(self, scene: str, graph: ViewGraph, pause: Callable[[], None]) -> Codes:
        """Links a scene that is judged with those before it that show the same; returns the codes of its images.

        What `pause` raises ends the work. Raises ResultWriteError.
        """
        if self._matcher is None:
            self._matcher = load_prior(self._config).matcher
        codes = {**self._codes, scene: codes_of(graph.keyframes)}
        common, near = in_common(codes), _near(scene, self._places.links)
        mine = Side(scene, graph, self._places.cameras(scene), centred(codes[scene], common))
        loops: list[Link] = []
        for other in [each for each in likeliest(scene, codes) if each not in near][:TRIED]:
            pause()
            link = self._bridged(other, mine, common, pause)
            give_back_memory()
            loops += [] if link is None else [link]
            if len(loops) == MOST_LOOPS:
                break
        self._places.add_loops(scene, loops)
        return codes[scene]

    def _graph(self, scene: str) -> ViewGraph:
        """Of a scene that was judged; an empty one where it cannot be read."""
        folder = left.folder_of(self._directory, scene)
        if folder.exists():
            try:
                with contextlib.closing(Store(folder)) as store:
                    return checkpoint.graph_of(store, self._config)
            except (CheckpointError, OSError, ValueError) as error:
                raise_shortage(error)
                log.warning("%s is not recognised again: %s", scene, error)
                self.forget(scene)
        return ViewGraph(self._config.matching)

    def _bridged(
        self, other: str, mine: Side, common: npt.NDArray[np.float32], pause: Callable[[], None]
    ) -> Link | None:
        graph, codes = self._graph(other), self._codes.get(other)
        if codes is None or len(graph.keyframes) != len(codes):
            return None  # something of it is damaged
        theirs = Side(other, graph, self._places.cameras(other), centred(codes, common))
        found, link = bridge(theirs, mine, self._config, self._matcher, pause), None
        if isinstance(found, Bridge):
            ends = found.one, found.other
            link = bridged(other, mine.scene_id, theirs.cameras, mine.cameras, ends, found.why)
        why = found if isinstance(found, str) else "together, their cameras lie otherwise" if link is None else link.why
        event(log, logging.INFO, "no_loop" if link is None else "loop", scene=mine.scene_id, other=other, why=why)
        return link


def _near(scene: str, links: tuple[Link, ...]) -> set[str]:
    """The scene, and those that at most NEAR links of its chain lead to."""
    near = {scene}
    for _ in range(NEAR):
        ends = [(each.scene, each.other) for each in links if each.kind is Kind.CHAIN]
        near |= {end for pair in ends if not near.isdisjoint(pair) for end in pair}
    return near
