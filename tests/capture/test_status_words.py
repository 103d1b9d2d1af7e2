"""What `splatnode status` says of a heartbeat."""

from __future__ import annotations

import msgspec

from splatnode.capture.status import _NOT_PRINTED, _WORDS, CaptureStatus, describe_heartbeat
from splatnode.recon.daemon import ReconStatus

RECON = {"state": "growing", "keyframe": 7, "queue": 17, "delay_s": 240.1, "keyframe_s": 26.4, "camera_moved": False}


def test_a_heartbeat_is_told_in_words_with_units():
    assert describe_heartbeat("recon", RECON) == [
        "recon: growing",
        "  last keyframe           number 7",
        "  keyframes waiting       17",
        "  delay                   240 s",
        "  last shown after        26 s",
        "  camera moved            no",
    ]


def test_what_is_not_known_yet_is_not_told():
    assert describe_heartbeat("recon", {"state": "waiting", "keyframe": -1, "keyframe_s": None, "problem": ""}) == [
        "recon: waiting"
    ]


def test_a_node_that_is_loading_says_so_and_no_zeros():
    fields = {
        "state": "loading",
        "keyframes": 0,
        "final": False,
        "delay_s": 2.0,
        "delay": "25 keyframes are being loaded",
    }
    assert describe_heartbeat("recon", fields) == [
        "recon: loading",
        "  delay                   2 s",
        "  because                 25 keyframes are being loaded",
    ]


def test_each_place_is_told_in_a_line_of_its_own():
    here = {"scene_id": "scene-0002", "state": "here", "verdict": "OK", "keyframes": 1, "left_out": 0, "seconds": 4.2}
    left = {"scene_id": "scene-0001", "state": "left", "verdict": "OK", "keyframes": 12, "left_out": 3, "rss_mb": 512.0}
    assert describe_heartbeat("recon", {"state": "growing", "newest_places": [left, here]}) == [
        "recon: growing",
        "  places                  scene-0001: left, OK, 12 photographs, 3 left out, 0 s of work, 512 MB",
        "                          scene-0002: here, OK, 1 photograph, 4 s of work, 0 MB",
    ]


def test_every_field_that_has_words_is_one_of_a_heartbeat():
    fields = {field.encode_name for status in (CaptureStatus, ReconStatus) for field in msgspec.structs.fields(status)}
    assert set(_WORDS) <= fields and fields | {"type"} >= _NOT_PRINTED


def test_what_the_node_does_is_told_with_the_rest_and_strange_values_as_they_are():
    work = {"doing": "refining the scene", "done": 210, "of": 500, "what": "step", "left_s": 6.2}
    assert describe_heartbeat("recon", {"state": "refining", "work": work}) == [
        "recon: refining",
        "  now                     refining the scene: 210 of 500 steps, about 6 s left",
    ]
    assert describe_heartbeat("recon", {"work": work | {"of": 0, "left_s": None}})[1].endswith("scene: 210 steps")
    for strange in (work | {"done": "many"}, work | {"left_s": [1]}, {"doing": 1}):
        assert describe_heartbeat("recon", {"work": strange})[1].endswith(str(strange))


def test_which_poses_hold_is_told_for_each_scene():
    worlds = [
        {"scene_id": "scene-0001", "revision": 3, "provisional": False, "why": "it moved"},
        {"scene_id": "scene-0002", "revision": 2, "provisional": True, "why": ""},
    ]
    assert describe_heartbeat("recon", {"state": "growing", "worlds": worlds}) == [
        "recon: growing",
        "  poses in                scene-0001: revision 3, final; earlier poses are withdrawn: it moved",
        "                          scene-0002: revision 2, provisional",
    ]
