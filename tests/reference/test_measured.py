"""No figure of a page differs from its raw file: blocks are what the code writes; prose has no results of its own."""

from __future__ import annotations

import copy
import re

import pytest

from tests.conftest import ROOT
from tests.reference.measured import ages, blocks, race, raw, scenes

DOCS = {path.name: path.read_text(encoding="utf-8") for path in blocks.find_pages()}
MEASURED = ("measurement.md", "scene_quality.md", "camera_accuracy.md", "robustness.md", "live.md")
RESULT = re.compile(r"[+−-]?(?:\d+\.\d+|\.\d+|\d+) ?(?:dB|%|°|px|GB|MB|ms|Hz|degrees|seconds|s\b|of \d)")
# Conditions, limits and what a publication does: words of the method, which no run has measured
CONDITIONS = frozenset(
    (
        *("2°", "5 %", "5°", "10 %", "95 %", ".4 %", "10 %", "5 cm", "90 %", "30 %", "15 %", "40 %", "20 %"),
        *(".05 s", "170°"),
    )
)


@pytest.mark.parametrize("name", DOCS)
def test_the_blocks_of_a_page_are_those_of_the_raw_files(name):
    assert blocks.fill(DOCS[name]) == DOCS[name], "a raw file or its words have changed; run: python -m tests.reference"


def test_each_block_is_on_one_page():
    assert sorted(each for text in DOCS.values() for each in blocks.list_names(text)) == sorted(blocks.BLOCKS)


def test_a_page_that_was_changed_by_hand_is_found():
    text = DOCS["scene_quality.md"]
    changed = re.sub(r"\| `balanced` \| \d+\.\d / ", "| `balanced` | 99.9 / ", text, count=1)
    assert changed != text and blocks.fill(changed) == text


def test_a_raw_file_that_was_changed_is_found(monkeypatch):
    changed = copy.deepcopy(raw.raw("growth"))
    changed["rows"][0]["peak_rss_mb"] += 100
    monkeypatch.setattr(scenes, "raw", lambda name: changed if name == "growth" else raw.raw(name))
    assert blocks.fill(DOCS["scene_quality.md"]) != DOCS["scene_quality.md"]


@pytest.mark.parametrize("name", MEASURED)
def test_prose_has_no_result_of_its_own(name):
    found = {match[0] for match in RESULT.finditer(blocks.cut(DOCS[name]))} - CONDITIONS
    assert not found, (
        f"docs/{name} prints {sorted(found)} outside a generated block: make it in tests/reference/measured/"
    )


def test_a_result_in_prose_is_found():
    assert [match[0] for match in RESULT.finditer("it gains .3 dB, in 14 of 21, by 99 % at 1.70 GB")] == [
        ".3 dB", "14 of 2", "99 %", "1.70 GB"
    ]  # fmt: skip


def test_words_that_a_raw_file_does_not_bear_out_are_refused():
    with pytest.raises(AssertionError, match="all in a scene"):
        raw.require(False, "all in a scene")


def test_all_rows_of_a_case_of_the_race_start_from_the_same_cameras():
    assert race.find_unlike_cases() == []


def test_every_raw_file_has_its_commit():
    assert set(ages.read_commits(DOCS["measurement.md"])) == {path.name for path in ages.list_raw_files()}


@pytest.mark.parametrize("name", sorted(ages.read_commits(DOCS["measurement.md"])))
def test_a_raw_file_is_that_of_its_commit(name):
    commit = ages.read_commits(DOCS["measurement.md"])[name]
    assert commit != ages.UNCOMMITTED, "commit the raw file, then run: python -m tests.reference"
    if not ages.has_commit(commit):
        pytest.skip("needs the project's whole history in git")
    assert ages.is_in_history(commit), "that commit was amended away; run: python -m tests.reference"
    assert ages.is_content_of(raw.RESULTS / name, commit), "commit the raw file, then run: python -m tests.reference"


def test_each_raw_file_is_named_on_a_page():
    pages = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").glob("*.md"))
    without_ages = pages.replace(DOCS["measurement.md"].partition("<!-- table: ages -->")[2], "")
    missing = [path.name for path in ages.list_raw_files() if path.name not in without_ages]
    assert not missing, "say on a page what these measure"


def test_each_trial_of_broken_lenses_is_judged_and_the_limits_say_how():
    keys, broken = ("scene", "count", "kind", "setting"), []
    for name in ("lens_assumptions", "lens_assumptions_draws", "lens_assumptions_later"):
        judged, trials = (raw.raw(each)["trials"] for each in (f"{name}_judged", name))
        assert [[each[key] for key in keys] for each in judged] == [[each[key] for key in keys] for each in trials]
        broken += [each for each in judged if each["kind"] != "clean"]
    limits = re.sub(r"\s+", " ", (ROOT / "docs" / "limits.md").read_text(encoding="utf-8"))
    assert f"of {len(broken)} sets made so that" in limits
    assert f"{sum(each['wrong'] for each in broken)} were published beyond their claim" in limits
