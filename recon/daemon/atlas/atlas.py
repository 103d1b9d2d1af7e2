"""All finished scenes of a node. Each is compared with those before it once it is final: did the camera come back?"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Mapping
from pathlib import Path

from splatnode.capture.process.logs import event
from splatnode.recon.config import Config
from splatnode.recon.daemon.atlas.bridge import Bridge, Side, bridge
from splatnode.recon.daemon.atlas.links import Kind, Link
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
        """`directory` is that of the checkpoint which has finished/ in it, `config` how scenes are made."""
        self._directory, self._config, self._places = directory, config, places
        self._matcher: Matcher | None = None
        self._codes: dict[str, Codes] = {}
        for folder in left.finished(directory):
            try:
                found = made_anew.load(folder, "codes", CodesRecord)
                self._codes |= {} if found is None else {folder.name: codes_from(found)}
            except ValueError as error:
                log.warning("%s is not recognised again: %s", folder.name, error)

    def keep(self, store: Store, graph: ViewGraph) -> None:
        """Writes into the checkpoint of a scene that is finished what it is recognised by later. Raises OSError."""
        codes = self._codes.get(store.scene_id)
        if codes is None or len(codes) != len(graph.keyframes):
            codes = codes_of(graph.keyframes)
        store.save("codes", *codes_message(graph.keyframes, codes))
        store.remove_shown()
        self._codes[store.scene_id] = codes

    def forget(self, scene: str) -> None:
        """The scene is not final any more."""
        self._codes.pop(scene, None)

    def compare(self, scene: str, graph: ViewGraph, pause: Callable[[], None]) -> None:
        """Links a final scene with those before it that show the same. What `pause` raises ends the work.

        Raises ResultWriteError.
        """
        if self._matcher is None:
            self._matcher = load_prior(self._config).matcher
        codes = {**self._codes, scene: codes_of(graph.keyframes)}
        near = _near(scene, self._places.links)
        loops: list[Link] = []
        for other in [each for each in likeliest(scene, codes) if each not in near][:TRIED]:
            pause()
            link = self._bridged(other, self._side(scene, graph, codes), codes, pause)
            loops += [] if link is None else [link]
            if len(loops) == MOST_LOOPS:
                break
        self._places.add_loops(scene, loops)

    def _graph(self, scene: str) -> ViewGraph:
        """Of a finished scene; an empty one where it cannot be read."""
        folder = left.finished_folder(self._directory, scene)
        if folder.exists():
            try:
                with contextlib.closing(Store(folder)) as store:
                    return checkpoint.graph_of(store, self._config)
            except (CheckpointError, OSError, ValueError) as error:
                log.warning("%s is not recognised again: %s", scene, error)
                self.forget(scene)
        return ViewGraph(self._config.matching)

    def _side(self, scene: str, graph: ViewGraph, codes: Mapping[str, Codes]) -> Side:
        return Side(scene, graph, self._places.cameras(scene), centred(codes[scene], in_common(codes)))

    def _bridged(self, other: str, side: Side, codes: dict[str, Codes], pause: Callable[[], None]) -> Link | None:
        theirs = self._graph(other)
        if len(theirs.keyframes) != len(codes[other]):
            return None  # something of it is damaged
        found = bridge(self._side(other, theirs, codes), side, self._config, self._matcher, pause)
        if not isinstance(found, Bridge):
            event(log, logging.INFO, "no_loop", scene=side.scene_id, other=other, why=found)
            return None
        link = self._places.bridged(other, side.scene_id, found)
        if link is not None:
            event(log, logging.INFO, "loop", scene=side.scene_id, other=other, why=link.why)
        return link


def _near(scene: str, links: tuple[Link, ...]) -> set[str]:
    """The scene, and those that at most NEAR links of its chain lead to."""
    near = {scene}
    for _ in range(NEAR):
        ends = [(each.scene, each.other) for each in links if each.kind is Kind.CHAIN]
        near |= {end for pair in ends if not near.isdisjoint(pair) for end in pair}
    return near
