"""Which learned parts are ready, and what is missing."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from splatnode.capture.process.config import parse_config
from splatnode.recon import networks, priors
from splatnode.recon.config import PriorChoice, ReconstructionConfig
from splatnode.recon.doctor import findings
from splatnode.recon.fallbacks import LearnedPart, find_unavailable_reason, list_learned_parts
from splatnode.recon.networks import CATALOGUE, Weights

PARTS = list_learned_parts()
PATCHMATCHNET = next(part for part in PARTS if part.name == "patchmatchnet")


def test_the_parts_are_what_there_is():
    learned = {part.name for part in PARTS if part.purpose == "prior"}
    assert {"aliked", "da3", "mast3r", "patchmatchnet", "xfeat"} <= learned <= set(PriorChoice.kinds())
    assert {file for part in PARTS for file in part.weights} <= {weights.path for weights in CATALOGUE}
    assert all(part.licence for part in PARTS)


def test_the_doctor_names_each_with_its_remedy_and_licence(monkeypatch, tmp_path):
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    told = {finding.name: finding for finding in findings()}
    for part in PARTS:
        assert told[part.name].state == "optional" and part.licence in told[part.name].detail
    assert "splatnode weights fetch MASt3R_ViTLarge" in told["mast3r"].detail
    assert "non-commercial" in told["mast3r"].detail and "Apache-2.0" in told["da3"].detail


def test_weights_that_are_there_are_checked(monkeypatch, tmp_path, shared):
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(shared / "weights"))
    assert find_unavailable_reason(PATCHMATCHNET) == ""
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    (file,) = PATCHMATCHNET.weights
    (tmp_path / file).parent.mkdir()
    Path(tmp_path / file).write_bytes(b"something else")
    assert "it has 14 bytes instead of 972171" in find_unavailable_reason(PATCHMATCHNET)


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_a_missing_package_comes_first(part: LearnedPart):
    assert find_unavailable_reason(replace(part, package="no_such_package")) == "pip install no_such_package"


NEW_PRIOR = """
from splatnode.recon.priors import classical
from splatnode.recon.priors.classical import ClassicalPrior

WEIGHTS = ("ours/ours.pth",)


class Config(classical.Config, frozen=True, forbid_unknown_fields=True):
    strength: float = 0.5


def load(config: Config) -> ClassicalPrior:
    return ClassicalPrior(config)
"""


def test_a_new_prior_is_its_file_and_an_entry_of_the_catalogue(monkeypatch, tmp_path):
    (tmp_path / "ours.py").write_text(NEW_PRIOR)
    monkeypatch.setattr(priors, "__path__", [*priors.__path__, str(tmp_path)])
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.delitem(sys.modules, "splatnode.recon.priors.ours", raising=False)
    chosen = parse_config({"prior": {"kind": "ours", "strength": 0.7}}, ReconstructionConfig).prior
    assert chosen.config.strength == 0.7 and chosen.module.load(chosen.config).matcher is None
    (part,) = (part for part in list_learned_parts() if part.name == "ours")
    assert "ours/ours.pth is not in the catalogue of weights" in find_unavailable_reason(part)
    entry = Weights("ours/ours.pth", "a test", "CC0", "https://example.org/ours.pth", None, None)
    monkeypatch.setattr(networks, "CATALOGUE", (*CATALOGUE, entry))
    (told,) = (finding for finding in findings() if finding.name == "ours")
    assert told.detail == "no weights: splatnode weights fetch ours; prior; weights: CC0"
    monkeypatch.delitem(sys.modules, "splatnode.recon.priors.ours")
