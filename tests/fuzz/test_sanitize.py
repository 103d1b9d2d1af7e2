"""What the sanitizers say of the core, for a moment; `python -m tests.fuzz.sanitize` asks for longer."""

from __future__ import annotations

import shutil

import pytest

from tests.fuzz import sanitize


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    if shutil.which("g++") is None:
        pytest.skip("needs g++ with the sanitizers' libraries")
    return sanitize.build(tmp_path_factory.mktemp("fuzz"))


def test_random_and_hostile_numbers_meet_no_defect(program):
    found = sanitize.fuzz(program, seconds=3.0, seed=5)
    assert found["defects"] == []
    assert set(found["calls"]) == {"bundle", "patchmatch", "partition", "match"}


def test_a_defect_is_told_with_its_round(tmp_path):
    program = tmp_path / "fuzz_core"
    program.write_text('#!/bin/sh\necho "{\\"round\\": $3, \\"kind\\": \\"match\\"}"\necho bad >&2\nexit 1\n')
    program.chmod(0o755)
    found = sanitize.fuzz(program, seconds=30.0, seed=7)
    assert [each["round"] for each in found["defects"]] == list(range(20))
    assert found["defects"][0] == {"round": 0, "kind": "match", "seed": 7, "ended": 1, "report": "bad\n"}
