"""The table of mutants does not rot, and what is done with one is right."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.conftest import ROOT
from tests.mutants.mutant import apply_mutant
from tests.mutants.table import MUTANTS

HONEST = ("recipes", "scoring", "fit")  # the rooms on which published figures rest


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_each_mutant_still_applies(mutant):
    assert apply_mutant(mutant, (ROOT / mutant.file).read_text(encoding="utf-8")) and mutant.find != mutant.replace


def test_names_are_different_and_the_faults_too():
    assert Counter(each.name for each in MUTANTS).most_common(1)[0][1] == 1
    assert Counter(each.digest for each in MUTANTS).most_common(1)[0][1] == 1
