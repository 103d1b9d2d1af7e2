import time

import pytest

from splatnode.recon.deadline import OutOfTime, pausing_until


def test_a_pause_is_asked_first_and_then_the_time():
    asked = []
    pausing_until(None, lambda: asked.append(1))()
    pausing_until(time.monotonic() + 1e6, lambda: asked.append(2))()
    with pytest.raises(OutOfTime):
        pausing_until(time.monotonic() - 1, lambda: asked.append(3))()
    assert asked == [1, 2, 3]
