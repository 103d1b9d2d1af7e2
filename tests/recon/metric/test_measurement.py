"""What sources say together, and that contradictions are found."""

from __future__ import annotations

import math

import numpy as np
import pytest

from splatnode.recon.metric.measurement import Measurement, combine_measurements


def test_the_surer_source_counts_for_more():
    agreed = combine_measurements([Measurement(2.0, 0.01, "a"), Measurement(2.04, 0.02, "b")])
    assert isinstance(agreed, Measurement) and agreed.source == "a; b"
    assert math.log(agreed.metres_per_unit / 2.0) == pytest.approx(math.log(1.02) / 5)  # weights 4 and 1
    assert agreed.sigma == pytest.approx(0.01 * math.sqrt(4 / 5))


def test_one_source_is_taken_as_it_is():
    alone = Measurement(0.3, 0.01, "a")
    assert combine_measurements([alone]) is alone
    with pytest.raises(ValueError, match="must have a source"):
        combine_measurements([])


def test_the_two_that_contradict_each_other_most_are_named():
    three = [Measurement(1.0, 0.01, "a"), Measurement(1.01, 0.01, "b"), Measurement(1.2, 0.01, "c")]
    refused = combine_measurements(three)
    assert isinstance(refused, str) and refused.startswith("a, contradicts c: the scales differ by 20 %")


def test_the_interval_holds_for_95_percent_and_what_is_20_percent_off_is_always_refused():
    rng = np.random.default_rng(3)
    held, refused, caught, trials = 0, 0, 0, 2000
    for _ in range(trials):
        first, second = (Measurement(math.exp(rng.normal(0.0, sigma)), sigma, str(sigma)) for sigma in (0.01, 0.02))
        agreed = combine_measurements([first, second])
        if isinstance(agreed, str):
            refused += 1
        else:
            low, high = agreed.interval_95
            held += low <= 1.0 / agreed.metres_per_unit <= high
        caught += isinstance(combine_measurements([first, Measurement(1.2 * second.metres_per_unit, 0.02, "c")]), str)
    assert refused <= 20 and 0.93 < held / (trials - refused) < 0.97
    assert caught >= 0.99 * trials
