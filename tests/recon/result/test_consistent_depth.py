"""The share of multi-view consistent depth, in the verdict's words and in a message of its own."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest

from splatnode.capture.messaging.messages import Header, WireError, decode, encode
from splatnode.recon.result.export.stored import decode_cameras, encode_cameras
from splatnode.recon.result.message import (
    DepthHeader,
    SceneHeader,
    add_depth_shares,
    decode_snapshot,
    make_depth_header,
)
from splatnode.recon.result.report import build_report
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.stored_snapshot import (
    ADVICE,
    ConsistentDepthConfig,
    append_consistent_depth,
    format_percent,
)
from splatnode.recon.result.verdict import Code, Verdict
from tests.recon.result.test_message import NUMBERED, sent, snapshot

OK = Verdict(Code.OK, "All 2 photographs were placed.", "", (), publishable=True)
LIMIT = ConsistentDepthConfig(min_share=0.4)


def shared(*shares: float | None) -> Snapshot:
    """A snapshot whose cameras have these shares."""
    made = snapshot(len(shares))
    cameras = (replace(each, consistent_depth=share) for each, share in zip(made.cameras, shares, strict=True))
    return replace(made, cameras=tuple(cameras))


def test_the_share_of_all_is_the_mean_of_the_views_and_unknown_where_one_is():
    assert shared(0.5, 0.7).consistent_depth == pytest.approx(0.6)
    assert shared(0.5, None).consistent_depth is None and shared().consistent_depth is None


def test_a_verdict_says_the_share_and_below_the_limit_that_other_views_are_guesses():
    enough = append_consistent_depth(OK, 0.4, LIMIT)
    assert enough.message == f"{OK.message} Other views confirm the depth of 40 % of the pixels."
    assert enough.advice == ""
    few = append_consistent_depth(replace(OK, advice="Lock exposure."), 0.399, LIMIT)
    assert few.message == (
        f"{OK.message} Other views confirm the depth of only 39 % of the pixels: "
        "views away from the cameras are guesses."
    )
    assert few.advice == f"Lock exposure. {ADVICE}" and few.code is Code.OK and few.publishable
    refused = Verdict(Code.NO_OVERLAP, "They share nothing.", "Take others.")
    assert append_consistent_depth(refused, 0.1, LIMIT) is refused and append_consistent_depth(OK, None, LIMIT) is OK


@pytest.mark.parametrize(("share", "words"), [(0.0, "0 %"), (0.29, "29 %"), (0.999, "99 %"), (1.0, "100 %")])
def test_a_share_is_rounded_down(share, words):
    assert format_percent(share) == words


def test_the_report_and_the_cameras_file_tell_the_share_of_each_view_and_of_all():
    made = shared(0.25, 0.75)
    report = msgspec.to_builtins(build_report(made, seed=0, preset="fast", peak_rss_mb=None))
    assert report["consistent_depth"] == 0.5
    assert [camera["consistent_depth"] for camera in report["cameras"]] == [0.25, 0.75]
    read = decode_cameras(encode_cameras(made.cameras))
    assert [camera.consistent_depth for camera in read] == [0.25, 0.75]
    unknown = build_report(shared(None, 0.5), seed=0, preset="fast", peak_rss_mb=None)
    assert unknown["consistent_depth"] is None
    earlier = b'{"cameras": []}'
    assert decode_cameras(earlier) == ()


class SceneHeaderBefore(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The fields of a scene that a viewer of before this message knows; it refuses any other."""

    scene_id: str
    code: str
    message: str
    advice: str
    frames: tuple[str, ...]
    publishable: bool
    provisional: bool
    cameras: tuple[CameraBefore, ...]
    dropped: tuple[tuple[str, str], ...]
    iterations: int
    seconds: dict[str, float]
    final: bool


class CameraBefore(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    frame_id: int
    T_world_camera: tuple[float, ...]
    K: tuple[float, ...]
    width: int
    height: int
    bounds: dict[str, object] | None
    captured_at: dict[str, object] | None = None


def test_an_older_viewer_takes_the_scene_and_a_newer_one_joins_the_shares_to_it():
    made = shared(0.25, None, 0.75)
    message = sent(made)
    before = [bytes(part) for part in encode(message.header, message.arrays)]
    assert len(decode(before, SceneHeaderBefore).header.cameras) == 3
    received = decode_snapshot(decode(before, SceneHeader)).snapshot
    assert received.consistent_depth is None
    depth = make_depth_header(made, "scene-0002", message.header.sequence, NUMBERED)
    parts = [bytes(part) for part in encode(depth)]
    joined = add_depth_shares(received, decode(parts, DepthHeader).header)
    assert [camera.consistent_depth for camera in joined.cameras] == [0.25, None, 0.75]


@pytest.mark.parametrize("wrong", [{"consistent_depth": 1.5}, {"views": [("a", -0.1)]}, {"scene_sequence": -1}])
def test_a_share_beyond_its_range_is_refused(wrong):
    header = make_depth_header(shared(0.5), "scene-0001", 7, NUMBERED)
    fields = msgspec.to_builtins(header) | wrong
    with pytest.raises(WireError):
        decode([bytes(part) for part in encode(msgspec.defstruct("Any", list(fields))(**fields))], DepthHeader)
