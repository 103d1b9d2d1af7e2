"""The benchmark of the queue, small: every good keyframe arrives, every refused one is named, nothing ends."""

from __future__ import annotations

from tests.bench.node.queue import KINDS, processes, two_ends

MESSAGES = 3 * len(KINDS)


def test_every_third_keyframe_is_refused_between_two_ends(tmp_path):
    row = two_ends(tmp_path, MESSAGES)
    assert row["refused"] == row["refused_and_named"] == row["refused_by_recon"] == len(KINDS)
    assert row["delivered_once"] and row["acknowledged"] == MESSAGES - len(KINDS)
    assert row["left"] == row["named_and_good"] == 0


def test_every_third_keyframe_is_refused_between_the_processes(tmp_path):
    row = processes(tmp_path, MESSAGES)
    assert row["refused"] == row["refused_and_named"] == row["refused_by_recon"] == len(KINDS)
    assert row["acknowledged"] == MESSAGES - len(KINDS) and row["left"] == row["named_and_good"] == 0
    assert row["exit_codes"] == {"capture": 0, "recon": 0}
    assert f"{len(KINDS)} keyframes were set aside" in row["capture_tells"]
    assert f"{len(KINDS)} keyframes that were refused" in row["recon_tells"]
