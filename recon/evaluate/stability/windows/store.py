"""What was matched in a scene, kept for all of its windows: what two frames share depends on no third one."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching.match import Matcher, completed
from splatnode.recon.matching.view_graph import ViewGraph


def matched(store: ViewGraph, keyframes: Sequence[Keyframe], matcher: Matcher | None) -> tuple[ViewGraph, ViewGraph]:
    """The complete view graph of `keyframes`, and the store with what was matched for it.

    The graph is that which matching from scratch gives: which pairs tilted features are chosen for is asked anew.
    """
    asked = ViewGraph(store.config)
    for keyframe in keyframes:
        asked = asked.with_keyframe(keyframe)
    known = store.without(set(store.names) - set(asked.names))
    (graph,) = deque(completed(asked.joined(known), matcher), maxlen=1)
    return graph, store.joined(graph)
