"""A reconstruction into the checkpoint and out of it again. What is missing there is made anew from the keyframes."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from splatnode.capture.frame import Frame
from splatnode.capture.process.system import is_shortage
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon.checkpoint import store as checkpoint_store
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.frames.keyframe import Features, Keyframe
from splatnode.recon.frames.screening import ScreeningState
from splatnode.recon.incremental import IncrementalReconstruction, ReconstructionCache, StreamState
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.modelling import prepare_scene_for_display
from splatnode.recon.preparation import prepare

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class RestoredReconstruction:
    work: IncrementalReconstruction
    keyframes: int
    new: list[Keyframe]  # that the reconstruction does not know yet
    final: bool  # whether its scene is as good as it gets


def save(store: Store, work: IncrementalReconstruction, final: bool) -> None:
    """Keeps what `work` knows; whether its scene is `final`. Raises OSError."""
    store.save("graph", *checkpoint_store.make_graph_message(work.graph))
    save_fallbacks(store, work)
    estimate = work.find_reconstruction()
    # Cameras that given poses hold have no evidence, and the rig of others is not kept, nor its metres: they are
    # estimated anew after a restart.
    is_kept = estimate is not None and estimate.publishable and estimate.evidence is not None
    if estimate is not None and is_kept and (estimate.registration is None or estimate.registration.rig is None):
        store.save("judgement", *checkpoint_store.make_reconstruction_message(estimate, work.publishable_names))
    if work.scene is not None:
        store.save("pointmaps", *checkpoint_store.make_pointmaps_message(work.state.pointmaps))
        store.save("scene", *checkpoint_store.make_scene_message(work.scene, final))


def save_fallbacks(store: Store, work: IncrementalReconstruction) -> None:
    """Keeps which fallbacks gained nothing. Raises OSError."""
    fruitless = work.state.memory.fruitless
    if fruitless:
        store.save("fallbacks", checkpoint_store.FallbacksRecord(list(fruitless)), [])


def restore(store: Store, config: ReconstructionConfig) -> RestoredReconstruction:
    """The reconstruction that the checkpoint holds. A frame that cannot be used is left out of it for good.

    Raises MemoryError and the like: what there is no memory for now is no fault of the files.
    """
    frames = [stored.frame for stored in store.frames()]
    try:
        return _restore_reconstruction(store, frames, config)
    except Exception as error:  # whatever the files of another version, or of a faulty disk, make fail
        if is_shortage(error):
            raise
        log.warning("the checkpoint's scene is made anew: %s: %s", type(error).__name__, error)
        keyframes = _prepare_keyframes(store, frames, config, {})
        return RestoredReconstruction(
            IncrementalReconstruction(config), len(keyframes), list(keyframes.values()), final=False
        )


def load_graph(store: Store, config: ReconstructionConfig) -> ViewGraph:
    """The view graph that the checkpoint holds; an empty one where it holds none. Raises OSError."""
    record = store.load("graph", checkpoint_store.GraphRecord)
    if record is None:
        return ViewGraph(config.matching)
    before = checkpoint_store.parse_graph(record)
    keyframes = _prepare_keyframes(store, [stored.frame for stored in store.frames()], config, before.features)
    return _make_graph(config, [keyframe for name, keyframe in keyframes.items() if name in before.features], before)


def _prepare_keyframes(
    store: Store, frames: Sequence[Frame], config: ReconstructionConfig, known: Mapping[str, Features]
) -> dict[str, Keyframe]:
    """The keyframes by their names, with the features that are known."""
    keyframes = {}
    for frame in frames:
        try:
            keyframes[frame.name] = prepare(frame, config, known.get(frame.name))
        except Exception as error:
            if is_shortage(error):
                raise
            log.error("%s cannot be used: %s", frame.name, error)
            with contextlib.suppress(OSError):  # the next start finds it again
                store.forget(frame.name, f"cannot be used: {error}")
    return keyframes


def _restore_reconstruction(
    store: Store, frames: Sequence[Frame], config: ReconstructionConfig
) -> RestoredReconstruction:
    record = store.load("graph", checkpoint_store.GraphRecord)
    before = checkpoint_store.parse_graph(record) if record is not None else checkpoint_store.SavedGraph({}, {}, [])
    keyframes = _prepare_keyframes(store, frames, config, before.features)
    record = store.load("scene", checkpoint_store.SceneRecord)
    scene = checkpoint_store.parse_scene(record, keyframes) if record is not None else None
    final = record is not None and record.header.final and scene is not None
    record = store.load("pointmaps", checkpoint_store.PointmapsRecord)
    graph = _make_graph(config, [keyframes[name] for name in keyframes if name in before.features], before)
    known = StreamState(
        graph,
        beside=ViewGraph(config.matching),
        screened=_screen_keyframes(graph),
        memory=_load_memory(store, graph),
        pointmaps=checkpoint_store.parse_pointmaps(record, keyframes) if record is not None else {},
        show=prepare_scene_for_display(scene, config),
    )
    new = [keyframe for name, keyframe in keyframes.items() if name not in before.features]
    return RestoredReconstruction(IncrementalReconstruction(config, known), len(keyframes), new, final)


def _make_graph(
    config: ReconstructionConfig, keyframes: Sequence[Keyframe], before: checkpoint_store.SavedGraph
) -> ViewGraph:
    """The view graph of the keyframes, with what an earlier process knew of their pairs."""
    position = {keyframe.name: index for index, keyframe in enumerate(keyframes)}
    pairs = {(position[i], position[j]): pair for (i, j), pair in before.pairs.items() if {i, j} <= position.keys()}
    pending = {(position[i], position[j]) for i, j in before.pending if {i, j} <= position.keys()}
    return ViewGraph(config.matching, tuple(keyframes), pairs, frozenset(pending))


def _screen_keyframes(graph: ViewGraph) -> ScreeningState:
    screened = ScreeningState()
    for keyframe in graph.keyframes:
        screened = screened.add_known_frame(keyframe.frame)
    return screened


def _load_memory(store: Store, graph: ViewGraph) -> ReconstructionCache:
    """Loads the estimate of exactly these keyframes, if there is one, and the fruitless fallbacks."""
    record = store.load("fallbacks", checkpoint_store.FallbacksRecord)
    memory = ReconstructionCache(fruitless=() if record is None else tuple(record.header.fruitless))
    record = store.load("judgement", checkpoint_store.ReconstructionRecord)
    if record is None or record.header.names != graph.names:
        return memory
    estimate, proven = checkpoint_store.parse_reconstruction(record, graph), frozenset(record.header.proven)
    return replace(memory, recent=(((tuple(graph.names), 0), estimate),), proven=proven)
