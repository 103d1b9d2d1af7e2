"""The thread that reconstructs: by what recipe."""

from __future__ import annotations

import threading

import pytest

from splatnode.recon.config import Config as Recipe
from splatnode.recon.config import Ladder
from splatnode.recon.daemon import worker
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.config import Config
from splatnode.recon.daemon.inbox import Inbox


@pytest.mark.parametrize(("asked", "seconds"), [(None, worker.LADDER_S), (20.0, 20.0)])
def test_more_matches_are_looked_for_within_seconds_since_keyframes_wait(asked, seconds, tmp_path, monkeypatch):
    recipes: list[Recipe] = []
    monkeypatch.setattr(worker, "PresentPlace", lambda config, recipe, *rest: recipes.append(recipe))
    config = Config(reconstruction=Recipe(ladder=Ladder(most_s=asked)), out=tmp_path / "out")
    worker.Worker(config, Store(tmp_path / "checkpoint"), Inbox(), lambda found: None, threading.Event())
    assert recipes[0].ladder == Ladder(work=Ladder().work, most_s=seconds)
