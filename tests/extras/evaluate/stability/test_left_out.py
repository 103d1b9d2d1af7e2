"""The honest parts of the fit: a scene's numbers know nothing of it, and rows are judged again by these numbers."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from splatnode.extras.evaluate.stability import fitting
from splatnode.extras.evaluate.stability.fitting import (
    Sample,
    exceeds_bounds,
    is_wrong,
    make_window_sample,
    passes_limits,
)
from splatnode.extras.evaluate.stability.trial import ROUGH, CameraError
from splatnode.extras.evaluate.stability.windows import OURS, WindowOutcome, WindowRow
from splatnode.recon.result.verdict import Code
from splatnode.recon.verification.error_model import ErrorModel, OddsModel, VerdictModel, compute_measures
from splatnode.recon.verification.fitted import FITTED
from splatnode.recon.verification.refit import Errors, PoseErrors
from tests.support.verdicts import evidence, unsure

SCENES = ("a", "b", "c")
LOOSE, STRICT = 100.0, -100.0  # priors with which all and nothing is published


def make_sample(rng: np.random.Generator, scene: str, far_deg: float = 0.0, **of_cameras: float) -> Sample:
    """Three cameras with errors of the size that the sources say; `far_deg` comes on top."""
    cameras, errors = {}, {}
    for index in range(3):
        rotation, centre = (float(np.exp(rng.normal(mean, 0.7))) for mean in (-2.0, -6.0))
        said = PoseErrors(Errors(rotation, rotation, 0.0), Errors(centre, centre, 0.0))
        cameras[index] = {"errors": said, "coverage": rng.uniform(0.4, 0.8), **of_cameras}
        found = rotation * abs(rng.normal()) + far_deg, 100 * centre * abs(rng.normal())
        errors[f"{index}.png"] = CameraError(f"{index}.png", *found, 5 * found[1], abs(rng.normal()))
    seen = evidence((0, 1, 2), cameras, inlier_ratio=of_cameras.get("inlier_ratio", 1.0))
    return Sample(scene, 3, True, True, False, seen, errors)


def make_samples() -> list[Sample]:
    """Those of a scene are right, but for two: half of their matches disagree, or in scene c nothing tells."""
    rng = np.random.default_rng(0)
    right = [make_sample(rng, scene, inlier_ratio=0.95) for scene in SCENES for _ in range(10)]
    ratios = {"a": 0.5, "b": 0.5, "c": 0.95}
    return [*right, *(make_sample(rng, s, 20.0, inlier_ratio=ratio) for s, ratio in ratios.items() for _ in range(2))]


def test_a_scene_s_numbers_know_nothing_of_it():
    samples = make_samples()
    worse = [
        replace(s, errors={n: replace(e, rotation_deg=3 * e.rotation_deg) for n, e in s.errors.items()})
        if s.scene == "a"
        else s
        for s in samples
    ]
    numbers, changed = fitting.fit_without_each_scene(samples), fitting.fit_without_each_scene(worse)
    assert list(numbers) == list(SCENES)
    assert changed["a"] == numbers["a"]
    assert changed["b"] != numbers["b"] and changed["c"] != numbers["c"]


def test_the_prior_refuses_the_most_convincing_wrong_one_as_the_other_scenes_judge_it():
    """By hand: the log odds of each wrong one by slopes of the other scenes; the largest is .5 below publishing."""
    samples = make_samples()
    claims = fitting.fit_bounds(samples)
    alone = VerdictModel(claims, OddsModel(0.0, {}))
    samples = [sample for sample in samples if sample.right or is_wrong(sample, alone)]  # the others are neither
    table = np.array([[compute_measures(s.evidence, claims)[name] for name in fitting.SIGNS] for s in samples])
    right, scenes = np.array([s.right for s in samples]), np.array([s.scene for s in samples])
    convincing = []
    for index, sample in enumerate(samples):
        if not right[index] and passes_limits(sample, alone) and exceeds_bounds(sample, alone):
            others = scenes != sample.scene
            model = fitting._fit_regression(table[others], right[others])
            terms = zip(model.terms.values(), table[index], strict=True)
            convincing.append(model.prior + sum(term.evaluate(value) for term, value in terms))
    whole = fitting._fit_regression(table, right)
    assert max(convincing) > 1.0  # in the other scenes nothing that looks like those of scene c is wrong
    found = fitting.fit_odds(make_samples(), claims)
    assert found.prior == pytest.approx(whole.prior - max(convincing) - 0.5 - 0.4, abs=0.01)


def test_a_wrong_registration_weighs_as_much_as_four_right_ones():
    """Of 30 right and 5 wrong ones that look alike, the log odds are log(30 / (4 * 5))."""
    right = np.arange(35) < 30
    model = fitting._fit_regression(np.ones((35, len(fitting.SIGNS))), right)
    assert model.prior == pytest.approx(math.log(30 / 20), abs=1e-3)


def test_gross_errors_are_no_errors_to_fit_bounds_to():
    samples = make_samples()
    assert [sample.is_gross for sample in samples[-6:]] == [True] * 6
    assert fitting.fit_bounds(samples) == fitting.fit_bounds(samples[:-6])


def test_a_bound_holds_for_96_of_100_errors_that_it_is_fitted_to():
    """Of 60 cameras that nothing tells apart, with errors of 1 to 60 degrees, 58 are within it."""
    said = Errors(0.1, 0.1, 0.0)
    lines = [fitting._ErrorSample("a", float(error), said, 1.0, 1.0, 3, False, False) for error in range(1, 61)]
    found = fitting._fit_bound_model(lines, fitting.FLOORS["rotation"])
    assert found.predict_bound(said, 3) == pytest.approx(58.0, rel=0.01)


def test_cameras_of_two_worlds_are_grossly_wrong():
    sample = next(each for each in make_samples() if each.right)
    mixed = replace(sample, errors=dict(list(sample.errors.items())[:2]))
    assert not sample.is_gross and sample.right
    assert mixed.is_gross and not mixed.right


def test_the_report_counts_windows_with_a_told_lens_apart():
    samples = make_samples()
    told = [replace(sample, has_known_lens=True) for sample in samples[:4]]
    matrix = [replace(sample, window=False) for sample in samples[:2]]
    numbers = fitting.fit_without_each_scene(samples)
    report: dict[str, Any] = fitting.make_report(fitting.pair_held_out_models([*samples, *told, *matrix], numbers))
    counts = {kind: report[kind]["sets"] for kind in ("windows", "windows_told", "matrix")}
    assert counts == {"windows": len(samples), "windows_told": 4, "matrix": 2}
    assert sum(row["sets"] for row in report["windows_by_count"].values()) == len(samples)


# Rows of windows.json, judged again


def make_row(scene: str, published: bool = True, wide: bool = False, **changes: object) -> WindowRow:
    """Three cameras that are right; `wide`: what the sources say makes bounds that are rough."""
    errors = tuple(CameraError(f"{i}.png", 0.01, 0.05, 0.2, 0.1) for i in range(3))
    said = evidence((0, 1, 2), {i: {"errors": unsure(1.5, 0.02)} for i in range(3)} if wide else {})
    row = WindowRow(
        scene=scene, count=3, stride=1, start=0, names=("0.png", "1.png", "2.png"), angle_deg=10.0, method=OURS,
        verdict="OK" if published else "AMBIGUOUS", published=published, message="", seconds=None, fresh_seconds=None,
        cameras=errors, rotation_deg=0.01, centre_pct=0.2, evidence=asdict(said),
    )  # fmt: skip
    return replace(row, **changes)


def by_scene(**priors: float) -> dict[str, VerdictModel]:
    claims: ErrorModel = FITTED.many.claims
    return {scene: VerdictModel(claims, OddsModel(prior, {})) for scene, prior in priors.items()}


def test_rows_are_published_and_refused_by_the_numbers_without_their_scene():
    rows = [make_row("a"), make_row("b"), make_row("a", published=False), make_row("b", published=False)]
    judged = fitting.rejudge_rows(rows, by_scene(a=LOOSE, b=STRICT))
    assert [row.published for row in judged] == [True, False, True, False]
    assert [row.verdict for row in judged] == ["OK", fitting.REFUSED, "OK", "AMBIGUOUS"]
    assert [row.outcome for row in judged] == [WindowOutcome.RIGHT, WindowOutcome.REFUSED] * 2
    assert all(camera.bounds is not None for row in judged for camera in row.cameras)  # theirs, not the product's


def test_what_is_known_roughly_is_called_so():
    exact, rough = fitting.rejudge_rows([make_row("a"), make_row("a", wide=True)], by_scene(a=LOOSE))
    assert (exact.verdict, rough.verdict) == (Code.OK.value, ROUGH) and rough.published
    part = make_row("a", count=4)
    assert fitting.rejudge_rows([part], by_scene(a=LOOSE))[0].verdict == Code.OK_PARTIAL.value


def test_a_wrong_camera_is_told_by_the_bounds_of_the_numbers_that_judged_it():
    far = tuple(replace(camera, rotation_deg=4.0) for camera in make_row("a").cameras)
    (judged,) = fitting.rejudge_rows([make_row("a", cameras=far)], by_scene(a=LOOSE))
    assert judged.published and judged.outcome is WindowOutcome.WRONG
    assert make_window_sample(judged).scene == "a" and exceeds_bounds(make_window_sample(judged), by_scene(a=0.0)["a"])


def test_what_cannot_be_judged_again_stays_as_it_is():
    nothing, foreign = make_row("a", evidence=None, method="colmap"), make_row("elsewhere")
    two = make_row("a", count=2, evidence=asdict(evidence((0, 1))))
    assert fitting.rejudge_rows([nothing, foreign, two], by_scene(a=STRICT)) == [nothing, foreign, two]
