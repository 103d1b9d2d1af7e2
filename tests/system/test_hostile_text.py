"""Every way in by which a stranger's text comes, with every kind of text: what people see of it only shows."""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from splatnode import command_line
from splatnode.capture.cameras import v4l2
from splatnode.capture.cameras.folder import Config, frame_name, stream
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.process.text import sanitize_text
from splatnode.capture.recording import Recorder
from splatnode.recon.daemon import node
from tests.support.hostile import TEXTS, unprintable

KEY = "0" * 40
PICTURE = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
NARROW = np.ascontiguousarray(PICTURE[:8])  # its features are found in a fraction of the time
FORGED = re.compile(r"^(<[0-9]+>|event=|time=|OK:)", re.MULTILINE)


def as_file(text: str, suffix: str = "") -> str:
    """The text as a name that a file can have."""
    shortened = text.replace("\x00", "").replace("/", "_").encode("utf-8", "surrogateescape")[: 250 - len(suffix)]
    return shortened.decode("utf-8", "surrogateescape") + suffix


def photograph(folder: Path, text: str) -> list[list[str]]:
    """Two that cannot be used, and one that can: what is said of each names it."""
    place = folder / "photographs"
    place.mkdir()
    (place / as_file(text, ".jpg")).write_bytes(b"\xff\xd8 no photograph")
    (place / as_file(text, ".heic")).write_bytes(b"")
    (place / as_file(f"good{text}", ".png")).write_bytes(cv2.imencode(".png", NARROW)[1].tobytes())
    replay = ["replay", str(place), "--no-fallbacks", "--out"]
    asked = ["--frames", as_file(text), "--baseline", text, text, "1"]
    return [[*replay, str(folder / "out")], [*replay, str(folder / "out2"), *asked], [*replay, "x", "--views", "9"]]


def video(folder: Path, text: str) -> list[list[str]]:
    good, bad = folder / as_file(text, ".mp4"), folder / as_file(f"bad{text}", ".mp4")
    writer = cv2.VideoWriter(str(folder / "a.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, (64, 48))
    writer.write(PICTURE)
    writer.release()
    (folder / "a.mp4").rename(good)
    bad.write_bytes(b"no video")
    for number, file in enumerate((good, bad, folder / "missing" / as_file(text))):
        camera = {"kind": "video", "file": str(file)}
        (folder / f"{number}.yaml").write_text(yaml.safe_dump({"camera": camera}, allow_unicode=False))
    return [["record", str(folder / f"{n}.yaml"), "--out", str(folder / as_file(f"{n}{text}"))] for n in range(3)]


def configuration(folder: Path, text: str) -> list[list[str]]:
    """A file that is not there, one that is no YAML, and keys and values that are not allowed."""
    wrong = folder / as_file(text, ".yaml")
    wrong.write_text("camera: [")
    keys = folder / "keys.yaml"
    keys.write_text(json.dumps({"camera": {"kind": "folder", "folder": "x", text: 1}}))
    kind = folder / "kind.yaml"
    kind.write_text(json.dumps({"camera": {"kind": text}, "network": {"tcp": text, "directory": str(folder / "run")}}))
    missing = folder / "missing" / as_file(text)
    verbs = [[verb, str(path)] for verb in ("capture", "status") for path in (wrong, keys, kind, missing)]
    return [*verbs, ["capture", str(keys), "--set", f"camera.{text}=1"], ["capture", str(keys), "--set", text]]


def output(folder: Path, text: str) -> list[list[str]]:
    place = folder / "photographs"
    place.mkdir()
    (place / "a.png").write_bytes(cv2.imencode(".png", NARROW)[1].tobytes())
    (folder / "file").write_bytes(b"")
    replay = ["replay", str(place), "--no-fallbacks", "--out"]
    return [[*replay, str(folder / as_file(text))], [*replay, str(folder / "file" / as_file(text))]]


def argument(folder: Path, text: str) -> list[list[str]]:
    named = str(folder / as_file(text))
    return [
        [text],
        ["view", named],
        ["view", named, text],
        ["export", named, "--to", "spz"],
        ["export", named, "--to", text],
        ["replay", named, "--out", "x"],
        ["replay", named, "--out", "x", "--size", text],
        ["weights", "fetch", text],
        ["weights", "verify", text],
        ["keygen", str(folder / "keys"), "--allow", text, KEY],
        ["keygen", str(folder / "keys"), "--allow", "laptop", text],
        ["keygen", str(folder / "keys"), "--server", text],
        ["bench", "--redraw", named, "--out", "x"],
        ["robustness", named, "--out", "x"],
    ]


WAYS_IN: dict[str, Callable[[Path, str], list[list[str]]]] = {
    each.__name__: each for each in (photograph, video, configuration, output, argument)
}


def said_by(arguments: list[str], capsys) -> str:
    """What a verb says on both streams."""
    with contextlib.suppress(SystemExit):
        command_line.main(arguments)
    captured = capsys.readouterr()
    return captured.out + captured.err


def assert_only_shows(said: str) -> None:
    assert said and not unprintable(said)
    assert not [line for line in said.split("\n") if FORGED.match(line)], said


@pytest.mark.parametrize("way", WAYS_IN)
@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_what_a_verb_says_only_shows(tmp_path, monkeypatch, capsys, way, text):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path / "weights"))
    for arguments in WAYS_IN[way](tmp_path, text):
        assert_only_shows(said_by(arguments, capsys))


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_what_a_process_says_of_itself_only_shows(monkeypatch, capsys, text):
    fields = {"state": text, "why": text, text: text, "rss_mb": 1.0}
    monkeypatch.setattr("splatnode.capture.cli.read_heartbeats", lambda network: {"capture": fields, "recon": None})
    assert_only_shows(said_by(["status"], capsys))
    assert ascii(json.loads(said_by(["status", "--json"], capsys))["capture"]) == ascii(fields)
    monkeypatch.setattr(node, "ask", lambda *_: node.Answer(False, f"no keyframe {text}"))
    assert_only_shows(said_by(["remove-keyframe", text], capsys))
    monkeypatch.setattr(v4l2, "find", lambda: [{"device": text, "description": text}])
    said = said_by(["list-cameras"], capsys)
    assert_only_shows(said)
    (line,) = [line for line in said.split("\n") if "v4l2" in line]
    assert ascii(yaml.safe_load(line)["camera"]["device"]) == ascii(text)  # it can be copied into a configuration


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_names_are_printable_from_the_camera_on_and_two_stay_two(tmp_path, text):
    content = cv2.imencode(".png", PICTURE)[1].tobytes()
    escaped = frame_name(Path(as_file(text)))
    files = {as_file(text, ".png"), as_file(escaped[:200], ".png"), as_file(f"{text}2", ".png")}
    for name in files:
        (tmp_path / name).write_bytes(content)
    items = [item for item in stream(Config(tmp_path)) if isinstance(item, Frame)]
    names = [item.name for item in items]
    assert len(set(names)) == len(items) == len({name for name in os.listdir(tmp_path) if not name.startswith(".")})
    assert all(name.isprintable() and len(name) <= 255 for name in names)
    assert [item.name for item in stream(Config(tmp_path, names=tuple(names)))] == names  # they can be asked for again


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_what_was_recorded_is_printable_and_two_stay_two(tmp_path, text):
    with Recorder(tmp_path / "recording") as recorder:
        for number in range(3):
            recorder.write(Frame(number, "x", number, PICTURE, None))
            recorder.write(DroppedFrame("y", "z"))
    index = tmp_path / "recording" / "splatnode-frames.jsonl"
    lines = [json.loads(line) for line in index.read_text().splitlines()]
    names = (f"a{text}", f"b{text}", sanitize_text(f"a{text}"))  # what somebody wrote who knows how names are shown
    for number, line in enumerate(lines):
        line["name"] = names[number // 2]
        line.update({"reason": text} if line["type"] == "dropped" else {})
    index.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    try:
        items = list(stream(Config(tmp_path / "recording")))
    except ValueError as error:
        assert "line 1" in str(error) and text == TEXTS["no text"]  # half a letter is no JSON
        return
    assert len({item.name for item in items if isinstance(item, Frame)}) == len(set(names))
    assert all(item.name.isprintable() for item in items)
    assert all(item.reason.isprintable() for item in items if isinstance(item, DroppedFrame))
