"""docs/calibrate.md has every model, and what it quotes is said."""

from __future__ import annotations

import argparse
import re

from splatnode.extras.calibration.board import Board
from splatnode.extras.calibration.estimate import MODELS
from splatnode.extras.verbs import CALIBRATE
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "calibrate.md").read_text(encoding="utf-8")
CODE = "\n".join(path.read_text() for path in sorted((ROOT / "extras" / "calibration").glob("*.py")))


def test_the_page_and_the_verb_have_every_model():
    assert re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE) == list(MODELS)
    parser = argparse.ArgumentParser()
    CALIBRATE.add_arguments(parser)
    (choices,) = [action.choices for action in parser._actions if action.dest == "model"]
    assert choices is not None and list(choices) == ["auto", *MODELS]


def test_models_are_in_the_order_of_their_terms():
    assert [model.num_terms for model in MODELS.values()] == sorted(model.num_terms for model in MODELS.values())


def test_what_the_page_quotes_of_a_refusal_is_said():
    _, _, table = PAGE.partition("| it says | cause and remedy |")
    quoted = re.findall(r"`([^`]+)`", "\n".join(line.split(" | ")[0] for line in table.splitlines()[2:13]))
    assert len(quoted) >= 10
    joined = re.sub(r'"\s*\n\s*f?"', "", CODE)
    for phrase in quoted:
        for part in re.sub(r"^\d+ ", "", phrase).split("..."):
            assert part.strip(" %") in joined, phrase


def test_the_page_says_how_large_the_printed_board_is():
    board = Board()
    assert f"ten squares across must be {board.columns * board.square_mm:g} mm, seven down" in PAGE
    assert f"seven down {board.rows * board.square_mm:g} mm" in PAGE
