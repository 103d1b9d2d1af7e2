"""What an audit says of many recordings."""

from __future__ import annotations

from xml.etree import ElementTree

from splatnode.extras.audit import MOVING, Audit, ImageFiles, SightingFailure, StationRecording
from splatnode.extras.audit_command import draw_audit, format_heading, format_lines, format_summary, make_values

NAMES = tuple(f"episode_{number:06d}" for number in range(100))
WRIST = {number: SightingFailure(f"{number}.png", MOVING, f"it turned by {number} degrees") for number in range(1, 99)}
TOP = {number: SightingFailure("a.png", "NOT_FOUND", "it shows another place") for number in (3, 7)}
AUDIT = Audit(NAMES, {}, {"wrist": WRIST, "top": TOP}, {99: "it is of version v2.1"}, [], 1.0, False)


def test_one_reason_in_many_recordings_is_one_line():
    assert list(format_lines(AUDIT)) == [
        "top was not compared in episode_000003: NOT_FOUND: it shows another place",
        "top was not compared in episode_000007: NOT_FOUND: it shows another place",
        "wrist was not compared in 98 recordings, the first episode_000001: MOVING: it turned by 1 degrees",
        "episode_000099 was not compared: it is of version v2.1",
    ]
    assert format_summary(AUDIT) == "0 of 2 cameras moved in 100 recordings; 0 could be compared"


def test_how_what_was_named_is_read_is_told_first():
    of_two = [
        StationRecording(name, {"left": ImageFiles(()), "right": ImageFiles(())}) for name in ("monday", "friday")
    ]
    assert format_heading(of_two) == "2 recordings, monday to friday, of 2 cameras: left, right"
    many = {f"camera{number}": ImageFiles(()) for number in range(9)}
    assert format_heading([StationRecording("days", many)]).startswith("1 recording, days, of 9 cameras: camera0, ")
    assert format_heading([StationRecording("days", many)]).endswith("camera7, ...")
    assert format_heading([StationRecording("lost", {}, "is not there")]) == "1 recording, lost, of 0 cameras"


def test_the_values_have_all_of_them():
    found = make_values(AUDIT)
    cameras = found["cameras"]
    assert isinstance(cameras, dict) and len(cameras["wrist"]["not_compared"]) == 98
    assert found["not_read"] == [{"recording": "episode_000099", "message": "it is of version v2.1"}]


def test_in_the_picture_what_cannot_be_read_is_a_cell_of_each_camera_that_says_why():
    told = [each.text for each in ElementTree.fromstring(draw_audit(AUDIT)).iter() if each.tag.endswith("title")]
    assert len(told) == 98 + 2 + 2 and told.count("it is of version v2.1") == 2
