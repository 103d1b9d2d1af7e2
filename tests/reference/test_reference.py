"""docs/configuration.md says what the code says, of every option there is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import pytest

from splatnode.capture.config import CaptureConfig
from splatnode.recon.daemon.config import DaemonConfig as Daemon
from tests.conftest import ROOT
from tests.reference.comments import field_comments
from tests.reference.options import REQUIRED, Option, sections, undescribed, values
from tests.reference.page import page, unit


class Base(msgspec.Struct, frozen=True):
    inherited: float = 0.5  # share of the whole


class Inner(Base, frozen=True):
    """What is within.

    Not of the summary.
    """

    both: int = 3  # what stands beside counts
    # Not this one
    spread: tuple[int, ...] = (
        4,  # the first
        5,
    )
    # Above, and
    # over two lines.
    above: int = 4

    # A heading of those below, which is no description.

    silent: int = 5


class Outer(msgspec.Struct, frozen=True):
    needed: Path  # where it is
    inner: Inner = Inner(both=7)  # an example
    perhaps: Inner | None = None  # one that need not be
    several: tuple[float, ...] = (1.5,)  # pixels


def test_the_page_is_what_the_code_says_now():
    written = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    assert written == page(), "an option or its comment has changed; run: python -m tests.reference"


@pytest.mark.parametrize("schema", [CaptureConfig, Daemon], ids=["capture", "recon"])
def test_every_option_is_described(schema):
    assert undescribed(sections(schema, internal=True)) == [], (
        "say in a comment at the field what it does, with its unit"
    )


def test_what_newcomers_asked_for_is_there():
    names = {option.name for schema in (CaptureConfig, Daemon) for each in sections(schema) for option in each.options}
    assert {"max_views", "idle_finalize_s", "new_submap_after"} <= names
    assert {"selection.coverage", "camera.device", "camera.folder"} <= names
    assert {
        "reconstruction.prior",
        "reconstruction.optimize.control.at",
        "reconstruction.decision.max_position_error_percent",
    } <= names
    assert {f"reconstruction.optimize.regularizers.losses.NAME.{each}" for each in ("weight", "patch")} <= names


def test_a_comment_is_beside_its_field_or_directly_above():
    assert field_comments(Inner) == {
        "inherited": "share of the whole",
        "both": "what stands beside counts",
        "spread": "the first",
        "above": "Above, and over two lines.",
    }


def test_sections_have_the_defaults_that_hold_where_they_stand():
    top, inner, perhaps = sections(Outer)
    assert {option.name: option.default for option in top.options} == {
        "needed": REQUIRED,
        "perhaps": None,
        "several": (1.5,),
    }
    assert (inner.name, inner.text) == ("inner", "an example")
    assert inner.options[1] == Option("inner.both", 7, "whole number", "what stands beside counts")
    assert (perhaps.name, perhaps.text) == ("perhaps", "What is within.")
    assert perhaps.options[1].default == 3


def test_an_option_without_a_comment_is_named():
    assert undescribed(sections(Outer)) == ["inner.silent", "perhaps.silent"]


@pytest.mark.parametrize(
    "annotation, words",
    [
        (Annotated[int, msgspec.Meta(ge=1, le=4)], "whole number 1 to 4"),
        (Annotated[float, msgspec.Meta(gt=0)], "number above 0"),
        (Path | None, "path or null"),
        (Annotated[float, msgspec.Meta(gt=0, le=1)], "number above 0 to 1"),
        (Annotated[int, msgspec.Meta(le=9)], "whole number up to 9"),
        (Literal["MJPG", "YUYV"], "MJPG or YUYV"),
        (tuple[int, ...], "list, each a whole number"),
        (tuple[float, float], "list: number, number"),
        (bool, "true or false"),
    ],
)
def test_values_are_told_with_their_range(annotation, words):
    assert values(annotation) == words


@pytest.mark.parametrize(
    "name, text, expected",
    [
        ("stable_s", "until then", "s"),
        ("camera.fps", "", "1/s"),
        ("size", "longer side of the modelled images, pixels", "px"),
        ("max_views", "photographs of many pixels", "–"),
        ("selection.coverage", "this share of the corners", "share"),
        ("independent", "inliers share errors of the scene", "–"),
    ],
)
def test_the_unit_is_in_the_name_or_the_description(name, text, expected):
    assert unit(Option(name, 1, "number", text)) == expected
