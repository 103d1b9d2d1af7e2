"""A long recording becomes scenes that are linked; what was interrupted goes on; nothing is mixed up or overwritten."""

from __future__ import annotations

import json
from itertools import islice

import pytest
from msgspec.structs import replace

from splatnode.recon import cli
from splatnode.recon.cli import check_incomplete, make_node_config, make_scenes, remove_checkpoint
from tests.recon.daemon.test_daemon import QUICK
from tests.support.synthetic import photographs

IDENTITY, OTHER = "a" * 32, "b" * 32


@pytest.fixture
def node(tmp_path):
    return replace(make_node_config(QUICK, tmp_path / "out"), max_views=4, idle_finalize_s=0.2)


def index(node) -> dict:
    return json.loads((node.out / "places.json").read_text())


def ignored(_: object) -> None:
    """Nobody watches."""


def test_a_long_recording_becomes_scenes_that_are_linked(node):
    shown = []
    make_scenes(photographs(), IDENTITY, node, shown.append)
    places = index(node)["places"]
    assert len(places) == 2 and not any(place["provisional"] for place in places)
    names = {frame.name for frame in photographs()}
    assert {name for place in places for name in place["frames_used"]} == names
    assert [(link["scene"], link["other"]) for link in index(node)["links"]] == [("scene-0001", "scene-0002")]
    assert (shown[-1].taken, shown[-1].judged, shown[-1].unfinished, shown[-1].maps) == (6, 2, 0, 1)
    assert str(shown[-1]) == "scenes: 2, maps: 1" and shown[-1].taken == 6


def test_what_was_interrupted_goes_on_where_it_was(node, monkeypatch):
    def interrupted():
        yield from islice(photographs(), 4)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_scenes(interrupted(), IDENTITY, node, ignored)
    prepared, prepare = [], cli.prepare
    monkeypatch.setattr(cli, "prepare", lambda frame, config: prepared.append(frame.name) or prepare(frame, config))
    make_scenes(photographs(), IDENTITY, node, ignored)
    assert prepared == [frame.name for frame in photographs()[4:]]
    names = {frame.name for frame in photographs()}
    assert {name for place in index(node)["places"] for name in place["frames_used"]} == names


def test_a_map_is_not_mixed_with_another_one_nor_written_over(node):
    with pytest.raises(ValueError, match="is that of another recording; remove it, or give another --out"):
        make_scenes(photographs()[:1], OTHER, node, ignored)
        make_scenes(photographs()[:1], IDENTITY, node, ignored)
    check_incomplete(node.out)
    (node.out / "places.json").write_text("{}")
    check_incomplete(node.out)
    remove_checkpoint(node.out)
    with pytest.raises(ValueError, match="holds the scenes of a map already; give another --out"):
        check_incomplete(node.out)


def test_a_photograph_that_cannot_be_used_is_named_and_stops_nothing(node, monkeypatch):
    def failing(frame, config, prepare=cli.prepare):
        if frame.name == photographs()[3].name:
            raise ValueError("for the test")
        return prepare(frame, config)

    monkeypatch.setattr(cli, "prepare", failing)
    make_scenes(photographs()[:4], IDENTITY, node, ignored)
    (place,) = index(node)["places"]
    assert len(place["frames_used"]) == 3
    assert place["frames_dropped"] == [{"name": photographs()[3].name, "reason": "cannot be used: for the test"}]


def test_what_ends_the_worker_ends_the_run(node, monkeypatch):
    def fail(*_: object) -> None:
        raise MemoryError("for the test")

    monkeypatch.setattr(cli.Worker, "_process_events", fail)
    with pytest.raises(MemoryError, match="for the test"):
        make_scenes(photographs(), IDENTITY, node, ignored)
