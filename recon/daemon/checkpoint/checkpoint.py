"""A reconstruction into the checkpoint and out of it again. What is missing there is made anew from the keyframes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

from splatnode.capture.frame import Frame
from splatnode.recon.daemon.checkpoint import saved, saved_judgement
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.reconstruction import LiveReconstruction
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.pipeline import prepare

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Restored:
    keyframes: int
    new: list[Keyframe]  # that the reconstruction does not know yet
    final: bool  # whether its scene is as good as it gets


def save(store: Store, work: LiveReconstruction, final: bool) -> None:
    """Keeps what `work` knows; whether its scene is `final`. Raises OSError."""
    store.save("graph", *saved.graph_message(work.graph))
    judged = work.judge()
    if judged.registration is not None and judged.verdict.publishable:
        store.save("judgement", *saved_judgement.judgement_message(judged, work.names, work.proven))
    if work.scene is not None:
        store.save("pointmaps", *saved_judgement.pointmaps_message(work.pointmaps))
        store.save("scene", *saved.scene_message(work.scene, final))


def restore(store: Store, work: LiveReconstruction) -> Restored:
    """Gives `work` what the checkpoint holds."""
    work.dropped = store.dropped
    frames = [stored.frame for stored in store.frames()]
    try:
        return _restored(store, frames, work)
    except ValueError as error:
        log.warning("the checkpoint's scene is made anew: %s", error)
        return Restored(len(frames), [prepare(frame, work.config) for frame in frames], final=False)


def _restored(store: Store, frames: Sequence[Frame], work: LiveReconstruction) -> Restored:
    record = store.load("graph", saved.GraphRecord)
    graph = saved.graph_from(record) if record is not None else saved.SavedGraph({}, {}, [])
    keyframes = {frame.name: prepare(frame, work.config, graph.features.get(frame.name)) for frame in frames}
    record = store.load("scene", saved.SceneRecord)
    scene = saved.scene_from(record, keyframes) if record is not None else None
    final = record is not None and record.header.final and scene is not None
    record = store.load("judgement", saved_judgement.JudgementRecord)
    judged = saved_judgement.judgement_from(record) if record is not None else None
    record = store.load("pointmaps", saved_judgement.PointmapsRecord)
    pointmaps = saved_judgement.pointmaps_from(record, keyframes) if record is not None else {}
    known = [keyframe for name, keyframe in keyframes.items() if name in graph.features]
    work.restore(known, graph.pairs, graph.pending)
    if judged is not None and list(judged.names) == work.names:
        work.restore_judgement(judged.judgement, judged.proven)
    work.pointmaps = pointmaps
    work.show(scene)
    return Restored(len(keyframes), [k for name, k in keyframes.items() if name not in graph.features], final)
