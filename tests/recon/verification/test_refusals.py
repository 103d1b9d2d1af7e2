"""The table of refusals: every entry is used, and whoever fills one in names just the fields of its sentence."""

from __future__ import annotations

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path
from string import Formatter

import pytest

import splatnode.recon
from splatnode.recon import verification
from splatnode.recon.result.verdict import Code
from splatnode.recon.verification import Refusal, decision, input_kinds, refuse
from splatnode.recon.verification.decision import CHECKS

ROOT = Path(splatnode.recon.__file__).parent
ENTRIES = {
    name: entry
    for module in (verification, decision, decision, input_kinds)
    for name, entry in vars(module).items()
    if isinstance(entry, Refusal)
}


@cache
def calls_of_refuse() -> dict[str, list[set[str | None]]]:
    """The keywords of every call of `refuse` in the product, by the entry that it fills in."""
    found = defaultdict(list)
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] == "refuse":
                entry = ast.unparse(node.args[0]).split(".")[-1]
                if entry.isupper():  # an entry is a constant; keyframes are refused, too
                    found[entry].append({keyword.arg for keyword in node.keywords})
    return found


def test_the_table_has_all_entries_that_are_filled_in_anywhere():
    assert set(calls_of_refuse()) == set(ENTRIES)


@pytest.mark.parametrize("name", ENTRIES)
def test_every_caller_names_the_fields_of_the_sentence_and_no_others(name):
    text = ENTRIES[name].message + ENTRIES[name].advice
    wanted = {field for _, field, _, _ in Formatter().parse(text) if field is not None}
    calls = calls_of_refuse()[name]
    assert calls and all(named == wanted for named in calls)


@pytest.mark.parametrize("name", ENTRIES)
def test_every_entry_is_a_code_a_sentence_and_an_advice(name):
    entry = ENTRIES[name]
    assert entry.code in Code and entry.advice.endswith(".")
    assert entry.message.endswith((".", "{found}"))


def test_an_entry_that_is_filled_in_is_a_verdict_without_a_scene():
    given = refuse(
        verification.FEW_SHARED_POINTS, ["a.png"], name="a.png", points=3, partner="b.png", centre=9, rotation=2
    )
    assert given.code == Code.NO_OVERLAP and given.frames == ("a.png",) and not given.publishable
    assert given.message.startswith("a.png shares only 3 points with two others at once")
    assert given.advice == "Add a photograph between a.png and b.png."
    with pytest.raises(KeyError, match="needed"):
        refuse(verification.ROUGHER, ["a.png"], found=1.0)


def test_verbs_agree_with_how_many_photographs_there_are():
    one, two = (refuse(verification.MIXED_CAMERAS, ["a.png"], others=others, count=5).message for others in (1, 2))
    assert one == "1 of 5 photographs has a size of its own, and its lens cannot be told."
    assert two == "2 of 5 photographs have a size of their own, and their lens cannot be told."
    one, two = (refuse(verification.MIRRORED_PHOTOGRAPHS, ["a.png"], count=count).message for count in (1, 2))
    assert one.startswith("1 photograph shows") and one.endswith("it matches the others better.")
    assert two.startswith("2 photographs show") and two.endswith("they match the others better.")


def test_whether_all_was_computed_is_asked_first():
    assert CHECKS[0] is decision.check_finite
