"""The fitting on registrations made up: it finds what they were made with, and what it writes is what it found."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from splatnode.extras.evaluate.stability import fitting
from splatnode.extras.evaluate.stability.fitting import (
    Sample,
    count_judgements,
    exceeds_bounds,
    fit_models,
    fit_without_each_scene,
    format_module,
    is_published,
    is_wrong,
    pair_held_out_models,
    read_samples,
)
from splatnode.extras.evaluate.stability.trial import CameraError
from splatnode.recon.verification.error_model import VerdictModels
from splatnode.recon.verification.fitted import FITTED
from splatnode.recon.verification.refit import Errors, PoseErrors
from tests.support.verdicts import evidence

RANDOM = np.random.default_rng(0)
SCENES = ("a", "b", "c", "d", "e")
RESULTS = Path(__file__).parents[3] / "bench" / "results"


def sample(scene: str, inlier_ratio: float = 0.95, far_deg: float = 0.0, count: int = 3) -> Sample:
    """Errors are drawn from what the sources say, which differs from camera to camera; `far_deg` comes on top."""
    cameras, errors = {}, {}
    for index in range(count):
        rotation = float(np.exp(RANDOM.normal(-2.0, 0.7)))
        centre = float(np.exp(RANDOM.normal(-6.0, 0.7)))
        said = PoseErrors(Errors(rotation, rotation, 0.0), Errors(centre, centre, 0.0))
        cameras[index] = {"errors": said, "inlier_ratio": inlier_ratio}
        found = rotation * abs(RANDOM.normal()) + far_deg, 100 * centre * abs(RANDOM.normal())
        errors[f"{index}.png"] = CameraError(f"{index}.png", *found, 5 * found[1], abs(RANDOM.normal()))
    seen = evidence(tuple(range(count)), cameras, inlier_ratio=inlier_ratio)
    return Sample(scene, count, True, True, False, seen, errors)


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    """In each scene twenty right ones, and two that are turned by 20 degrees while half of their matches disagree."""
    right = [sample(scene, count=count) for scene in SCENES for count in (3, 6) for _ in range(10)]
    return right + [sample(scene, inlier_ratio=0.5, far_deg=20.0) for scene in SCENES for _ in range(2)]


def test_the_bounds_hold_for_as_many_errors_as_they_should(samples):
    judged = pair_held_out_models(samples, fit_without_each_scene(samples))
    found = count_judgements([pair for pair in judged if pair[0].right])
    assert found.right_published == found.right and found.beyond == 0
    # A bound is never below 2.5 standard errors, within which 98.8 % of these errors are.
    assert found.rotations_within is not None and 0.9 <= found.rotations_within <= 0.995
    assert found.centres_within is not None and 0.9 <= found.centres_within <= 0.995


def test_a_bound_grows_with_what_the_sources_say(samples):
    model = fitting.fit_bounds(samples).rotation
    narrow, wide = (model.predict_bound(Errors(size, size, 0.0), 3) for size in (0.2, 2.0))
    assert 4.0 * narrow < wide
    assert model.predict_bound(Errors(0.2, 0.2, 50.0), 3) == 100.0  # what the focal length leaves open, twice


def test_wrong_registrations_are_refused_by_numbers_that_did_not_see_their_scene(samples):
    numbers = fit_without_each_scene(samples)
    bad = [each for each in samples if each.is_gross]
    assert len(bad) == 10 and not any(is_published(each, numbers[each.scene]) for each in bad)
    assert all(is_wrong(each, numbers[each.scene]) for each in bad)


def test_a_measure_never_counts_the_wrong_way(samples):
    found = fitting.fit_odds(samples, fitting.fit_bounds(samples)).terms
    assert set(found) == {*fitting.FOR, *fitting.AGAINST, "own_lens"} and found["own_lens"].slope <= 0
    assert all(found[name].slope >= 0 for name in fitting.FOR) and all(
        found[name].slope <= 0 for name in fitting.AGAINST
    )
    assert found["inlier_ratio"].slope > 0 or found["camera_inlier_ratio"].slope > 0


def with_own_lens(of: Sample, broken: bool, times: float = 1.0) -> Sample:
    """The sample as one of which an image has a lens of its own, with errors so many times as large."""
    cameras = tuple(replace(camera, own_lens=index == 0) for index, camera in enumerate(of.evidence.cameras))
    errors = {
        name: replace(error, rotation_deg=times * error.rotation_deg, centre_pct=times * (error.centre_pct or 0.0))
        for name, error in of.errors.items()
    }
    return replace(of, evidence=replace(of.evidence, cameras=cameras), errors=errors, broken=broken)


def test_sets_that_break_the_assumption_of_one_lens_widen_the_bounds_of_such_sets_alone(samples):
    broken = [with_own_lens(each, broken=True, times=2.0) for each in samples if each.right]
    without, found = fitting.fit_bounds(samples), fitting.fit_bounds([*samples, *broken])
    assert found.rotation.factor == without.rotation.factor and found.centre.factor == without.centre.factor
    assert without.rotation.own_lens == 1.0
    assert 1.4 < found.rotation.own_lens < 3.0 and 1.4 < found.centre.own_lens < 3.0


def test_more_must_speak_for_poses_with_a_lens_of_its_own_where_such_were_wrong(samples):
    seen = [replace(each, evidence=with_own_lens(each, True).evidence) for each in samples if each.is_gross]
    good = [replace(each, inlier_ratio=0.95) for each in seen[0].evidence.cameras]
    convincing = [
        replace(s, broken=True, evidence=replace(s.evidence, cameras=tuple(good), inlier_ratio=0.95)) for s in seen
    ]
    claims = fitting.fit_bounds(samples)
    without, found = fitting.fit_odds(samples, claims), fitting.fit_odds([*samples, *convincing], claims)
    assert without.terms["own_lens"].slope == 0.0
    assert found.prior == without.prior and found.terms["own_lens"].slope < -1.0


def test_cameras_of_two_worlds_are_beyond_every_claim(samples):
    mixed = replace(samples[0], errors=dict(list(samples[0].errors.items())[:2]))
    assert not mixed.is_one_world and exceeds_bounds(mixed, fit_models(samples))


def test_the_module_that_is_written_holds_what_was_found(samples):
    numbers = fit_models(samples)
    namespace: dict[str, object] = {}
    exec(compile(format_module(VerdictModels(numbers, numbers)), "fitted.py", "exec"), namespace)
    assert namespace["FITTED"] == VerdictModels(numbers, numbers)


def test_no_number_of_the_verdict_was_typed_in():
    """recon/verification/fitted.py is what the fitting found from the raw results that are kept."""
    kept = json.loads((RESULTS / "fit.json").read_text())["numbers"]
    assert kept == json.loads(json.dumps(asdict(FITTED)))


def test_other_files_are_refused(tmp_path):
    (tmp_path / "bench.json").write_text('{"runs": []}')
    with pytest.raises(ValueError, match=r"bench\.json must be a windows\.json or a stability\.json"):
        read_samples([tmp_path / "bench.json"])
