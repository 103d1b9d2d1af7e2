"""The bound of an error, worked out by hand: a product of powers, and never less than a source says."""

from __future__ import annotations

import math

import pytest

from splatnode.recon.verification.error_model import BoundModel
from splatnode.recon.verification.refit import Errors

NOTHING = {"floor": 0.0, "sigma": 0.0, "regions": 0.0, "profile": 0.0, "inlier_ratio": 0.0, "link": 0.0, "count": 0.0}


def model(**powers: float) -> BoundModel:
    return BoundModel(**{"factor": 1e-3, **NOTHING, **powers})


def test_a_bound_is_a_product_of_powers():
    powers = {"sigma": 0.5, "regions": 1.0, "profile": 0.25, "inlier_ratio": -1.0, "link": -0.5, "count": 0.5}
    found = model(factor=10.0, own_lens=2.0, **powers)
    errors = Errors(0.04, 0.5, 0.0625)
    alone = 10.0 * 4**0.5 * 0.2 * 0.5 * 0.5
    assert found.predict_bound(errors, 4) == pytest.approx(alone)
    assert found.predict_bound(errors, 4, inlier_ratio=0.5, link=0.25) == pytest.approx(alone * 2.0 * 2.0)
    assert found.predict_bound(errors, 4, own_lens=True) == pytest.approx(2.0 * alone)
    assert found.predict_bound(errors, 4, inlier_ratio=0.0) == pytest.approx(alone / 0.05)  # fewer count as 5 %


def test_a_bound_is_never_less_than_a_source_says():
    """Two and a half standard errors, twice what the focal length leaves open, and what regions differ by."""
    for errors, least in ((Errors(2.0, 0.1, 0.1), 5.0), (Errors(0.1, 3.0, 0.1), 3.0), (Errors(0.1, 0.1, 4.0), 8.0)):
        assert model().predict_bound(errors, 3) == pytest.approx(least)


@pytest.mark.parametrize(
    "unknown", [Errors(math.nan, 0.1, 0.1), Errors(0.1, math.nan, 0.1), Errors(0.1, 0.1, math.nan)]
)
def test_what_is_not_a_number_bounds_nothing(unknown):
    assert math.isnan(model(sigma=1.0, regions=1.0, profile=1.0).predict_bound(unknown, 3))
    assert math.isnan(model().predict_bound(unknown, 3))


def test_what_is_infinite_stays_so():
    assert model(sigma=1.0).predict_bound(Errors(math.inf, 0.1, 0.1), 3) == math.inf
