"""Whatever could not be computed refuses: every number of the evidence and of the registration, one at a time."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

from splatnode.recon.registration.registration import RegisteredCamera, Registration
from splatnode.recon.result.verdict import Code
from splatnode.recon.verification import error_model, refit
from splatnode.recon.verification import evidence as consistency
from splatnode.recon.verification import evidence as verification_evidence
from splatnode.recon.verification.decision import CHECKS, WORDS, DecisionConfig, VerificationCase, check_finite, decide
from splatnode.recon.verification.evidence import Evidence, find_non_finite
from splatnode.recon.verification.fitted import FITTED
from splatnode.recon.verification.refit import Errors, FreedLens
from tests.recon.verification.test_refit import made_up
from tests.support.verdicts import all_pairs, evidence, graph, registration, unsure

ALL = (0, 1, 2)
GOOD = evidence(ALL, freed=(FreedLens(1000.0, True, 1000.0, 1000.0, 1.0),))
NOT_FINITE = (math.nan, math.inf, -math.inf)
Path = tuple[str | int, ...]


def numbers_of(record: type, at: Path = ()) -> Iterator[Path]:
    """Where each number of a record type is, as its annotations say: field names, and 0 for the first of a tuple."""
    for field in fields(record):
        annotation = get_type_hints(record)[field.name]
        path: Path = (*at, field.name)
        if get_args(annotation)[1:] == (Ellipsis,):
            annotation, path = get_args(annotation)[0], (*path, 0)
        if is_dataclass(annotation):
            yield from numbers_of(annotation, path)
        elif annotation in (float, int):
            yield path
        else:
            assert annotation in (str, bool), f"{field.name} is of a type that this walk does not know: {annotation}"


def with_number(record: Any, path: Path, value: float) -> Any:
    """The record with another number at `path`."""
    if not path:
        return value
    first, *rest = path
    if isinstance(first, int):
        return (*record[:first], with_number(record[first], tuple(rest), value), *record[first + 1 :])
    return replace(record, **{first: with_number(getattr(record, first), tuple(rest), value)})


def weighed(seen: Evidence) -> error_model.Odds:
    return error_model.compute_log_odds(seen, FITTED.many.claims, FITTED.many.odds)


EVERY_NUMBER = tuple(numbers_of(Evidence))


def test_the_walk_over_types_finds_the_numbers_wherever_they_are():
    for path in (
        ("cameras", 0, "focal", "sigma"),
        ("weakest_link", "shared_points"),
        ("freed", 0, "found"),
        ("rms_px",),
    ):
        assert path in EVERY_NUMBER
    assert decide(graph(3, all_pairs(3)), registration(ALL), GOOD, DecisionConfig()).code == Code.OK


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("path", EVERY_NUMBER, ids=lambda path: ".".join(map(str, path)))
def test_every_number_of_the_evidence_that_could_not_be_computed_refuses(path, value):
    seen = with_number(GOOD, path, value)
    given = decide(graph(3, all_pairs(3)), registration(ALL), seen, DecisionConfig())
    assert given.code == Code.UNDETERMINED and not given.publishable
    assert WORDS[path[0]] in given.message and given.message.endswith(".") and given.advice.endswith(".")
    assert given.frames == (("0.png",) if path[0] == "cameras" else ("0.png", "1.png", "2.png"))


@pytest.mark.parametrize("path", EVERY_NUMBER, ids=lambda path: ".".join(map(str, path)))
def test_no_limit_lets_a_number_pass_that_could_not_be_computed(path, monkeypatch):
    """Without the check of all numbers, the odds do not hide NaN, and refuse where they have it."""
    monkeypatch.setattr("splatnode.recon.verification.decision.CHECKS", CHECKS[1:])
    good, odds = (weighed(seen) for seen in (GOOD, with_number(GOOD, path, math.nan)))
    before, after = ([*each.terms.values()] for each in (good, odds))
    if before != after:
        given = decide(graph(3, all_pairs(3)), registration(ALL), with_number(GOOD, path, math.nan), DecisionConfig())
        assert any(math.isnan(piece) for piece in after) and not given.publishable


@pytest.mark.parametrize("limited", ["travel", "mirrored_cost", "flatness", "inlier_ratio"])
def test_every_limit_refuses_nan_by_itself(limited, monkeypatch):
    monkeypatch.setattr("splatnode.recon.verification.decision.CHECKS", CHECKS[1:])
    given = decide(graph(3, all_pairs(3)), registration(ALL), replace(GOOD, **{limited: math.nan}), DecisionConfig())
    assert not given.publishable


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("field", ["T_world_camera", "focal", "principal", "radial"])
def test_a_pose_that_is_not_a_number_refuses(field, value):
    found = registration(ALL)
    camera = found.cameras[1]
    wrong = np.full_like(camera.T_world_camera, value) if field == "T_world_camera" else value
    wrong = np.full(2, value) if field == "principal" else np.array([value, 0.0]) if field == "radial" else wrong
    cameras = (found.cameras[0], replace(camera, **{field: wrong}), found.cameras[2])
    given = decide(graph(3, all_pairs(3)), replace(found, cameras=cameras), GOOD, DecisionConfig())
    assert given.code == Code.UNDETERMINED and "the poses themselves" in given.message


def test_the_root_of_a_negative_variance_refuses():
    """Registration says infinity where the covariance of a focal length or of a pose came out negative."""
    found = registration(ALL)
    of_third = replace(found.cameras[2], rotation_sigma_deg=math.inf, centre_sigma_rel=math.inf)
    found = replace(found, cameras=(*found.cameras[:2], of_third), focal_sigma=math.inf)
    of_unsure = replace(GOOD.cameras[2], errors=unsure(math.inf, math.inf))
    seen = replace(GOOD, cameras=(*GOOD.cameras[:2], of_unsure), focal=Errors(math.inf, math.inf, math.inf))
    given = decide(graph(3, all_pairs(3)), found, seen, DecisionConfig())
    assert given.code == Code.UNDETERMINED and given.frames == ("2.png",)
    assert "how certain the focal length is" in given.message and "how certain each pose is" in given.message


def test_each_field_of_the_evidence_has_words_for_the_user():
    assert set(WORDS) == {field.name for field in fields(Evidence)}


def test_what_is_finite_is_let_pass():
    assert check_finite(VerificationCase(GOOD, DecisionConfig(), FITTED.many, graph(3, {}), registration(ALL))) is None
    assert list(find_non_finite(GOOD)) == []


def test_arrays_and_mappings_are_walked_too():
    found = replace(registration(ALL), points=np.array([[0.0, np.nan, 1.0]]), inlier_ratios={(0, 1): math.inf})
    assert list(find_non_finite(found)) == [("points",), ("inlier_ratios", "(0, 1)")]
    assert {field.name for field in fields(Registration)} >= {"points", "inlier_ratios"}
    assert is_dataclass(RegisteredCamera)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("path", EVERY_NUMBER, ids=lambda path: ".".join(map(str, path)))
def test_what_is_not_finite_is_none_in_the_report(path, value):
    broken = with_number(GOOD, path, value)
    written = json.loads(json.dumps(error_model.make_evidence_record(broken, weighed(broken)), allow_nan=False))
    found = written
    for step in path:
        found = found[step]
    assert found is None
    if path == ("inlier_ratio",):
        assert written["log_odds"]["total"] is None and written["rms_px"] == GOOD.rms_px


def test_a_mirrored_answer_that_could_not_be_computed_is_not_the_lack_of_a_rival(monkeypatch):
    """The smaller of 100, which stands for no rival, and NaN is NaN."""
    fit = made_up()
    broken = replace(fit, problem=replace(fit.problem, points=np.full_like(fit.problem.points, np.nan)))
    assert math.isnan(replace(fit, problem=replace(fit.problem, translations=np.full((4, 3), np.nan))).cost)
    adjusted = iter([fit, replace(broken, problem=replace(fit.problem, translations=np.full((4, 3), np.nan)))])
    monkeypatch.setattr(refit, "adjust", lambda start: next(adjusted))
    assert math.isnan(refit.compute_reversal_cost_ratio(fit))


def test_flatness_of_points_that_are_nowhere_is_not_known():
    points = np.random.default_rng(0).uniform(size=(50, 3))
    points[7, 2] = np.nan
    assert math.isnan(verification_evidence.compute_share_on_plane(points))


def test_a_gain_by_mirroring_that_is_not_a_number_is_not_passed_over(monkeypatch):
    gains = iter([0.0, math.nan, 0.0])
    monkeypatch.setattr(consistency, "_compute_gain", lambda *_: next(gains))
    monkeypatch.setattr(consistency, "_select_descriptors", lambda features, count: np.zeros((4, 128), np.uint8))
    assert math.isnan(
        consistency.measure_reflection(
            graph(3, {}).keyframes, [(0, 1), (0, 2), (1, 2)], consistency.ReflectionConfig()
        ).gain
    )
