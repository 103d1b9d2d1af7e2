"""What a configuration may say: nothing that grows when it is read, and nothing that ends what reads it."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatnode.capture.config import CaptureConfig
from splatnode.capture.process.arguments import counts, megabytes, natural, percent, positive, seconds, size
from splatnode.capture.process.config import ConfigError, load_config, parse_yaml
from splatnode.capture.process.text import MAX_NUMBER
from tests.support.crafted import Crafted
from tests.support.crafted.bounded import MARGIN, readings

GOOD = "camera: {kind: synthetic}"


def read_file(file: Crafted) -> str:
    """For the process that reads the corpus."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "crafted.yaml")
        path.write_bytes(file.data)
        return str(load_config(path, CaptureConfig))


def read_change(file: Crafted) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "good.yaml")
        path.write_text(GOOD)
        return str(load_config(path, CaptureConfig, [file.data.decode()]))


@pytest.mark.parametrize(("corpus", "reader"), [("configurations", "read_file"), ("changes", "read_change")])
def test_every_crafted_configuration_is_refused_in_little_memory(corpus, reader):
    for reading in readings(f"tests.support.crafted:{corpus}", f"{__name__}:{reader}"):
        assert reading.outcome.startswith("ConfigError: "), reading
        assert len(reading.outcome) < 2000 and reading.taken < MARGIN, reading


@given(st.text(alphabet="ab:{}[],-&*!|>?%@'\"\n .0159e~<_", max_size=60))
def test_any_text_is_a_value_or_refused(text):
    try:
        value = parse_yaml(text, "text")
    except ConfigError as error:
        assert str(error).startswith("text")
    else:
        assert value is None or isinstance(value, bool | int | float | str | list | dict)


def test_limits_are_named():
    with pytest.raises(ConfigError, match=rf"x: line 2: expected a number within ±{MAX_NUMBER}, got \.nan"):
        parse_yaml("a: 1\nb: .nan", "x")
    with pytest.raises(ConfigError, match="line 1: aliases .* are not read; write the value out"):
        parse_yaml("a: *b", "x")
    with pytest.raises(ConfigError, match="more than 10000 values, or deeper than 32"):
        parse_yaml("[" * 33, "x")
    with pytest.raises(ConfigError, match="expected keys that are text and differ"):
        parse_yaml("{a: 1, a: 2}", "x")


def test_a_configuration_is_a_file(tmp_path):
    with pytest.raises(ConfigError, match="must be a file, is a pipe or a device"):
        load_config(Path("/dev/zero"), CaptureConfig)
    with (tmp_path / "large.yaml").open("wb") as file:
        file.truncate(50_000_000_000)
    with pytest.raises(ConfigError, match="50000000000 bytes; at most 262144"):
        load_config(tmp_path / "large.yaml", CaptureConfig)


@pytest.mark.parametrize("convert", [positive, natural, seconds, megabytes, percent, size, counts])
@pytest.mark.parametrize(
    "text", ["nan", "inf", "-inf", "1e400", "9" * 5000, str(2**63), "-1", "", "x", "\x1b[2J", "٣" * 30]
)
def test_a_number_of_the_command_line_is_finite_and_in_its_range(convert, text):
    with pytest.raises(argparse.ArgumentTypeError) as raised:
        convert(text)
    assert str(raised.value).isprintable() and len(str(raised.value)) < 300
