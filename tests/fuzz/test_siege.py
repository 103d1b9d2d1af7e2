"""The siege in short form: a crowd without a key, a process with few descriptors, and nothing is lost."""

from __future__ import annotations

import os

import pytest

from tests.fuzz.siege import Force, besiege

FILES = 440  # of which capture has need, and a few more


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="descriptors are counted in /proc")
def test_a_crowd_without_a_key_costs_those_who_have_it_nothing():
    found = besiege(2.0, 0, Force(strangers=800, files=FILES, photographs=12, with_recon=False))
    assert not found["defects"], found
    assert found["counts"]["keyframes taken"] == 12 and found["counts"]["pages given"] > 0
    assert found["counts"]["most descriptors of capture"] < FILES - 100
