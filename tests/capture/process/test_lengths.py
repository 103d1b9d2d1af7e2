from __future__ import annotations

import pytest

from splatnode.capture.process.text import format_length, metres, parse_measurement


def test_a_length_has_its_unit():
    assert [metres(text) for text in ("100mm", " 10 cm", "0.1m", ".1m")] == pytest.approx([0.1] * 4)
    assert parse_measurement("100mm@0.2mm") == pytest.approx((0.1, 0.0002))
    assert parse_measurement("75mm") == (0.075, None)
    assert (format_length(0.1), format_length(1.5)) == ("100 mm", "1.5 m")


@pytest.mark.parametrize("wrong", ["100", "mm", "-1mm", "0mm", "1e3mm", "nan m", "2km", "100mm@", "100mm@1", "9999m"])
def test_what_is_no_length_is_refused(wrong):
    with pytest.raises(ValueError, match="a length must have its unit"):
        parse_measurement(wrong)
