"""The race's cases hold nothing back, and its methods differ only in what their names say."""

from __future__ import annotations

import json

from splatnode.extras.evaluate.methods import extract_start_config
from splatnode.recon.config import preset
from tests.bench.quality import race


def test_no_held_out_photograph_trains_and_no_case_comes_twice():
    cases = race.cases()
    assert len(cases) >= 16 and len({(case.name, len(case.train)) for case in cases}) == len(cases)
    for case in cases:
        assert case.test and not set(case.train) & set(case.test) and len(case.train) in (3, 6, 12)


def test_a_case_lies_under_its_own_name_beside_its_split(tmp_path):
    case = race.Case("fox_window", "fox", ("a.jpg", "c.jpg", "e.jpg"), ("b.jpg",))
    (tmp_path / "scenes" / "fox").mkdir(parents=True)
    for _ in range(2):  # a race that goes on finds it there
        place = race.linked(case, tmp_path / "scenes", tmp_path / "out")
    assert place.name == "fox_window" and place.resolve() == (tmp_path / "scenes" / "fox").resolve()
    listed = json.loads((place.parent / "splits.json").read_text())
    assert listed == {"fox_window": {"train3": ["a.jpg", "c.jpg", "e.jpg"], "test": ["b.jpg"]}}


def test_methods_of_the_race_start_from_what_ours_starts_from():
    field = race.Field(12345)
    ours = extract_start_config(preset("balanced"))
    for name in ("pixel", "pixel+fill", "mcmc", "mcmc+fill", "instantsplat-xl+fill"):
        assert field.start_of(name) == ours
    mcmc, filled = field.config("mcmc"), field.config("mcmc+fill")
    assert mcmc is not None and filled is not None and mcmc.max_gaussians == filled.max_gaussians == 12345
    assert mcmc.pixelwise is not None and filled.pixelwise is not None
    assert (mcmc.pixelwise.surroundings, filled.pixelwise.surroundings) == ("none", "fill")
    assert field.config("balanced") is None
