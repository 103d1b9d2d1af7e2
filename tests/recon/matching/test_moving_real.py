"""Wallpaper that repeats does not move."""

from __future__ import annotations

from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.evaluate.truth import load_scene
from splatnode.recon.matching import moving
from splatnode.recon.matching.match import match
from splatnode.recon.preparation import prepare

NAMES = ("0007.jpg", "0009.jpg", "0012.jpg", "0029.jpg", "0031.jpg", "0033.jpg", "0035.jpg")


def test_a_wall_whose_pattern_repeats_stands_still(shared, monkeypatch):
    """Two groups of photographs show other parts of one wallpaper, which match each other."""
    config = ReconstructionConfig()
    keyframes = [prepare(frame, config) for frame in load_scene(shared / "scenes" / "fox").frames(NAMES)]
    graph = match(keyframes, config.matching)
    assert moving.moving_masks(graph) == {}
    monkeypatch.setattr(moving, "RESTS", len(NAMES))  # nothing is at rest so often
    assert len(moving.moving_masks(graph)) >= moving.MIN_SHOWN
