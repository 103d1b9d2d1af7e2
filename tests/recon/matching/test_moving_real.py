"""Wallpaper that repeats does not move."""

from __future__ import annotations

from splatnode.extras.evaluate.dataset import load_scene
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import prepare
from splatnode.recon.matching import view_graph
from splatnode.recon.matching.view_graph import match

NAMES = ("0007.jpg", "0009.jpg", "0012.jpg", "0029.jpg", "0031.jpg", "0033.jpg", "0035.jpg")


def test_a_wall_whose_pattern_repeats_stands_still(shared, monkeypatch):
    """Two groups of photographs show other parts of one wallpaper, which match each other."""
    config = ReconstructionConfig()
    keyframes = [prepare(frame, config) for frame in load_scene(shared / "scenes" / "fox").frames(NAMES)]
    graph = match(keyframes, config.matching)
    assert view_graph.moving_masks(graph) == {}
    monkeypatch.setattr(view_graph, "RESTS", len(NAMES))  # nothing is at rest so often
    assert len(view_graph.moving_masks(graph)) >= view_graph.MIN_SHOWN
