"""Which learned parts are ready, and what is missing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from splatnode.recon.config import PriorChoice
from splatnode.recon.doctor import findings
from splatnode.recon.networks.capabilities import PARTS, Part, obstacle
from splatnode.recon.networks.catalogue import CATALOGUE

PATCHMATCHNET = next(part for part in PARTS if part.name == "patchmatchnet")


def test_the_parts_are_what_there_is():
    assert {part.name for part in PARTS if part.purpose == "prior"} <= set(PriorChoice.kinds())
    assert {file for part in PARTS for file in part.files} <= {weights.path for weights in CATALOGUE}
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
    assert obstacle(PATCHMATCHNET) == ""
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    (file,) = PATCHMATCHNET.files
    (tmp_path / file).parent.mkdir()
    Path(tmp_path / file).write_bytes(b"something else")
    assert "it has 14 bytes instead of 972171" in obstacle(PATCHMATCHNET)


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_a_missing_package_comes_first(part: Part):
    assert obstacle(replace(part, package="no_such_package")) == "pip install no_such_package"
