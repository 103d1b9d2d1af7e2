"""Whatever a parser of foreign bytes raises is the refusal of its boundary."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from splatnode.capture.process.text import guard_untrusted


class Refused(Exception):
    pass


def endless() -> None:
    endless()


@pytest.mark.parametrize(
    "parse",
    [
        lambda: np.frombuffer(b"").reshape([0, 2**62, 4]),
        lambda: struct.unpack("<I", b""),
        lambda: {}["missing"],
        lambda: int("9" * 5000),
        lambda: np.zeros(2**62),
        endless,
    ],
)
def test_what_a_parser_raises_is_a_refusal_that_names_the_source(parse):
    with pytest.raises(Refused, match="scene.ply"), guard_untrusted(Refused, "scene.ply"):
        parse()


def test_a_refusal_is_left_as_it_is():
    refusal = Refused("too many Gaussians")
    with pytest.raises(Refused) as raised, guard_untrusted(Refused, "scene.ply"):
        raise refusal
    assert raised.value is refusal


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt(), SystemExit(0)])
def test_what_is_not_the_strangers_fault_passes(error):
    with pytest.raises(type(error)), guard_untrusted(Refused, "scene.ply"):
        raise error


def test_what_a_parser_repeats_of_a_stranger_stays_on_one_line():
    with pytest.raises(Refused) as refused, guard_untrusted(Refused, "a.json"):
        raise ValueError("a\nevent=keyframe name=forged\x1b[2J" + "x" * 100_000)
    assert str(refused.value).isprintable() and len(str(refused.value)) < 1100
