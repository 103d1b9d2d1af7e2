"""What cameras say of their photographs' light: as pixels answer, and only where it can be compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.capture.frame import ExposureSettings, Frame
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.scene.exposure import compute_exposure_priors
from tests.support.row_of_views import NO_FEATURES


def told(*exposures: ExposureSettings | None) -> dict[str, float]:
    image = np.zeros((6, 8, 3), np.uint8)
    frames = [Frame(i, f"{i}", 0, image, None, exposure=each) for i, each in enumerate(exposures)]
    return compute_exposure_priors(Keyframe(frame, image, NO_FEATURES) for frame in frames)


PLAIN = ExposureSettings(0.01, 100.0)
STOPPED = ExposureSettings(0.01, 100.0, 4.0)


def test_pixels_answer_with_a_power_of_the_light():
    found = told(PLAIN, replace(PLAIN, time_s=0.02), None, replace(PLAIN, iso=400.0))
    assert found.keys() == {"0", "1", "3"}
    assert found["1"] - found["0"] == pytest.approx(np.log(2.0) / 2.2)
    assert found["3"] - found["0"] == pytest.approx(np.log(4.0) / 2.2)
    wider = told(STOPPED, replace(STOPPED, f_number=2.0))
    assert wider["1"] - wider["0"] == pytest.approx(np.log(4.0) / 2.2)
    assert told(None, None) == {}


def test_what_tells_an_aperture_is_not_compared_with_what_tells_none():
    assert told(PLAIN, STOPPED, STOPPED).keys() == {"1", "2"}
    assert told(PLAIN, STOPPED, PLAIN).keys() == {"0", "2"}
    assert told(PLAIN, STOPPED).keys() == {"1"}
