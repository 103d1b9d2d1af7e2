"""The thread that reconstructs: by what recipe, and what it takes in."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from splatnode.capture.frame import Frame
from splatnode.capture.messaging.messages import ReceivedFrame
from splatnode.recon.config import FallbackConfig
from splatnode.recon.config import ReconstructionConfig as Recipe
from splatnode.recon.daemon import worker
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.daemon.ingest import ArrivedKeyframe, Inbox, RemovedFrame
from splatnode.recon.estimation import prepare


@pytest.mark.parametrize(("asked", "seconds"), [(None, worker.FALLBACK_TIMEOUT_S), (20.0, 20.0)])
def test_more_matches_are_looked_for_within_seconds_since_keyframes_wait(asked, seconds, tmp_path, monkeypatch):
    recipes: list[Recipe] = []
    monkeypatch.setattr(worker, "ActiveSubmap", lambda config, recipe, *rest: recipes.append(recipe))
    config = DaemonConfig(reconstruction=Recipe(fallbacks=FallbackConfig(timeout_s=asked)), out=tmp_path / "out")
    worker.Worker(config, Store(tmp_path / "checkpoint"), Inbox(), lambda found: None, threading.Event())
    assert recipes[0].fallbacks == FallbackConfig(budget=FallbackConfig().budget, timeout_s=seconds)


@pytest.mark.parametrize("again", [False, True], ids=["retracted", "retracted, and another of its name came"])
def test_what_was_retracted_before_it_was_prepared_is_not_taken_in(again, tmp_path, monkeypatch):
    taken: list[list[ArrivedKeyframe]] = []
    place = SimpleNamespace(settled=True, owed=[], add_keyframes=taken.append, remove_frames=lambda names: None)
    monkeypatch.setattr(worker, "ActiveSubmap", lambda *_: place)
    store, inbox = Store(tmp_path / "checkpoint"), Inbox()
    node = worker.Worker(DaemonConfig(out=tmp_path / "out"), store, inbox, lambda found: None, threading.Event())
    image = np.zeros((48, 64, 3), np.uint8)
    stored = [store.add_frame(ReceivedFrame("a" * 32, n, Frame(n, f"{n}.png", n, image, None))) for n in range(2)]
    store.forget("0.png", "retracted")
    if again:
        store._names["0.png"] = 2  # once a thousand others were dropped, or in another place
    inbox.enqueue_now(RemovedFrame("0.png"))
    arrived = [ArrivedKeyframe(prepare(each.frame, Recipe()), 0.0) for each in stored if each is not None]
    for each in arrived:
        inbox.enqueue([each], threading.Event())
    while len(inbox):
        node._process_events(0.0)
    assert taken == [arrived[1:]]
    inbox.enqueue(arrived[:1], threading.Event())
    node._process_events(0.0)
    assert taken == [arrived[1:]]  # nor is there anything to be made better
