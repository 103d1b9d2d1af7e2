"""A program hears by Python warnings, at its own line, what the command line tells on its log."""

from __future__ import annotations

import contextlib
import logging
import subprocess
import sys
import warnings

import numpy as np
import pytest

import splatnode
from splatnode.api.arguments import sanitize_error
from splatnode.capture.process import config
from splatnode.capture.process.terminal import InputWarning, give_warnings, gives_warnings, notify
from tests.api.test_publisher import changes, picture, publisher
from tests.capture.test_depth_files import make_scannet
from tests.conftest import ROOT

FORMER = {"quick": True}


def here(heard) -> list[tuple[type[Warning], str]]:
    """What was heard, all of it at lines of this file."""
    assert {each.filename for each in heard} <= {__file__}
    return [(each.category, str(each.message)) for each in heard]


@pytest.mark.parametrize("entrance", ["reconstruct", "Session", "Publisher"])
def test_a_former_key_of_each_entrance_is_a_deprecation_at_the_line_of_the_program(tmp_path, entrance):
    former = {"selection": {"per_second": 3.0}}
    begin = {
        "reconstruct": lambda: splatnode.reconstruct([np.zeros((8, 8, 3), np.uint8)], config=FORMER, views=2),
        "Session": lambda: splatnode.Session(config=FORMER).close(),
        "Publisher": lambda: splatnode.Publisher(changes=changes(tmp_path, **former)).close(),
    }
    with warnings.catch_warnings(record=True) as heard, contextlib.suppress(ValueError):  # views of one image
        warnings.simplefilter("always")
        begin[entrance]()
    told = [text for kind, text in here(heard) if kind is DeprecationWarning]
    assert told and "the former name is read in this release only" in told[0]


def test_what_is_left_out_of_an_input_is_a_warning(tmp_path):
    make_scannet(tmp_path)
    (tmp_path / "depth/1.png").write_bytes(b"nothing")
    with pytest.warns(splatnode.InputWarning, match="1.png: its depth image is left out") as heard:
        splatnode.reconstruct(tmp_path, config={"size": 64, "no_fallbacks": True})
    assert {kind for kind, _ in here(heard)} == {InputWarning} and issubclass(InputWarning, UserWarning)


def test_a_doubtful_unit_of_a_single_depth_image_is_a_warning(tmp_path):
    depth = splatnode.DepthImage(np.full((240, 320), 2, np.uint16))
    with (
        publisher(tmp_path) as node,
        pytest.warns(splatnode.InputWarning, match="median is 2: probably metres") as heard,
    ):
        assert node.publish(picture(), depth=depth).taken
    here(heard)


def test_the_log_has_what_no_program_hears_and_nothing_twice(caplog):
    log = logging.getLogger("splatnode.test")
    notify(log, "left out")
    with warnings.catch_warnings(record=True) as heard, give_warnings():
        warnings.simplefilter("always")
        notify(log, "also left out")
        assert gives_warnings()
    assert not gives_warnings() and [record.message for record in caplog.records] == ["left out"]
    assert here(heard) == [(InputWarning, "also left out")]


def test_python_shows_a_program_its_former_names():
    code = "import splatnode; splatnode.Session(config={'quick': True}).close()"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "DeprecationWarning: quick is called no_fallbacks now" in done.stderr
    assert "<string>:1" in done.stderr


def test_a_key_is_told_to_a_program_though_the_log_had_it_before(caplog):
    config._warn_once.cache_clear()
    config._tell_of_key("a is called b now")
    config._tell_of_key("a is called b now")
    assert [record.message for record in caplog.records] == ["a is called b now"]
    with give_warnings(), pytest.warns(DeprecationWarning, match="a is called b now"):
        config._tell_of_key("a is called b now")


HOSTILE = "x\x1b[31m\u202e"


def test_errors_have_text_that_only_shows_whoever_wrote_it(result, tmp_path):
    saved = result.save(tmp_path / "saved")
    report = (saved / "report.json").read_text()
    (saved / "report.json").write_text(report.replace('"OK', '"\\u001b[31mOK', 1))
    for attempt in (
        lambda: splatnode.load(saved),
        lambda: splatnode.connect(f"a/{HOSTILE}"),
        lambda: splatnode.Session(config={"prior": {"kind": HOSTILE}}),
        lambda: splatnode.Session(config={"size": HOSTILE}),
        lambda: splatnode.reconstruct([np.zeros((8, 8, 3), np.uint8)], depths={f"{HOSTILE}.png": np.zeros((8, 8))}),
        lambda: splatnode.Publisher(changes={"network": {HOSTILE: 3}}),
    ):
        with pytest.raises((ValueError, TypeError)) as raised:
            attempt()
        error: BaseException | None = raised.value
        while error is not None:
            assert str(error).replace("\n", "").isprintable(), repr(str(error))
            error = error.__cause__ or error.__context__


def test_an_error_keeps_its_lines_and_what_is_no_text():
    error = OSError(2, "no\x1bthing", "file")
    error.__cause__ = ValueError("one\ntwo\x07")
    sanitize_error(error)
    assert error.args == (2, "no\\x1bthing") and error.filename == "file"
    assert str(error.__cause__) == "one\n  two\\x07"


def test_a_warning_has_text_that_only_shows(caplog):
    with give_warnings(), pytest.warns(InputWarning, match=r"x\\x1b\[31m\\u202e"):
        notify(logging.getLogger("splatnode.test"), HOSTILE)
