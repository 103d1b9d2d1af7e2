"""Internal keys and former names: what a file may still hold for one release, and what is said of it."""

from __future__ import annotations

from typing import Annotated

import msgspec
import pytest

from splatnode.capture.process import config
from splatnode.capture.process.config import ConfigError, Internal, parse_config, parse_layers


class Depth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    patch_px: int = 3
    iterations: Internal[Annotated[int, msgspec.Meta(ge=1)]] = 8


class Stage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    enabled: bool = True
    depth: Depth = Depth()
    tuning: Internal[Depth] = Depth()


class Room(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    stage: Stage = Stage()
    fps: float = 10.0
    former_keys = {"rate": "fps", "step": "stage", "stage.depth.patch": "patch_px"}


class House(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    room: Room = Room()
    rate: int = 0
    former_keys = {"chamber": "room"}


@pytest.fixture(autouse=True)
def _tell_anew():
    config._warn_once.cache_clear()


def test_a_former_name_is_read_and_told_once(caplog):
    for _ in range(2):
        assert parse_config({"rate": 5.0}, Room).fps == 5.0
    assert [record.message for record in caplog.records] == [
        "rate is called fps now; write fps: the former name is read in this release only"
    ]


def test_former_names_hold_from_the_top_of_their_room_on(caplog):
    read = parse_config({"chamber": {"step": {"depth": {"patch": 7}}, "rate": 4.0}, "rate": 2}, House)
    assert (read.room.stage.depth.patch_px, read.room.fps, read.rate) == (7, 4.0, 2)
    assert len(caplog.records) == 4 and all("release only" in record.message for record in caplog.records)


def test_a_later_layer_wins_by_either_name():
    assert parse_layers([{"rate": 5.0}, {"fps": 6.0}], Room).fps == 6.0
    assert parse_layers([{"fps": 5.0}, {"rate": 6.0}], Room).fps == 6.0


def test_a_key_by_both_its_names_is_refused():
    with pytest.raises(ConfigError, match="fps: given twice, once as rate; give it once"):
        parse_config({"rate": 5.0, "fps": 5.0}, Room)


def test_an_internal_key_is_read_and_told_once_for_all_below_it(caplog):
    changes = {"stage": {"tuning": {"patch_px": 4, "iterations": 2}, "depth": {"iterations": 3}}}
    read = parse_config(changes, Room)
    assert (read.stage.tuning.iterations, read.stage.depth.iterations) == (2, 3)
    ends = "is internal: it will be a constant in the next release; leave it out"
    assert [record.message for record in caplog.records] == [f"stage.tuning {ends}", f"stage.depth.iterations {ends}"]


def test_internal_keys_keep_their_limits():
    with pytest.raises(ConfigError, match=r"stage\.depth\.iterations: expected int >= 1"):
        parse_config({"stage": {"depth": {"iterations": 0}}}, Room)


def test_an_unknown_key_is_refused_with_the_nearest_and_without_internal_ones():
    with pytest.raises(ConfigError) as caught:
        parse_config({"stage": {"enable": False}}, Room)
    assert str(caught.value) == (
        "stage.enable: unknown key; allowed here: enabled, depth; the nearest is stage.enabled"
    )
    with pytest.raises(ConfigError) as caught:
        parse_config({"stage": {"colour": 1}}, Room)
    assert str(caught.value).endswith("allowed here: enabled, depth")


def test_what_stands_under_a_key_is_told_with_it(caplog):
    parse_config({"depth": {"patch_px": 2, "iterations": 2}}, Stage, "room.stage")
    assert caplog.records[0].message.startswith("room.stage.depth.iterations is internal")
