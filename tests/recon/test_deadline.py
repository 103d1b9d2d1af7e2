import time

import pytest

from splatnode.recon.threads import OutOfTime, make_deadline_pause


def test_a_pause_is_asked_first_and_then_the_time():
    asked = []
    make_deadline_pause(None, lambda: asked.append(1))()
    make_deadline_pause(time.monotonic() + 1e6, lambda: asked.append(2))()
    with pytest.raises(OutOfTime):
        make_deadline_pause(time.monotonic() - 1, lambda: asked.append(3))()
    assert asked == [1, 2, 3]
