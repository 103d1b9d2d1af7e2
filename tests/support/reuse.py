"""What the native core finds in an image, and between two, is found once in a process: hundreds of tests begin with it.

Nothing else is reused, and nothing between processes. What is computed is the product's own, for whatever a test gives
it: an image, a configuration, and a limit of threads that were not seen before are computed. Tests of features, of
matches and of the core itself (`AFRESH`) compute all of it each time.
"""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import pytest

AFRESH = (
    "tests/recon/core",
    "tests/recon/matching",
    "tests/recon/test_threads",
    "tests/recon/test_no_clock",
    "tests/gpu",
)
REMEMBERED = 256  # results of a function, of half a megabyte at most

_active = True


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("dist", "no") != "no":  # the process that hands tests to others runs none
        return
    from splatnode.recon.matching import features  # here: pytest --help needs no product

    for name in ("_detect", "match"):
        setattr(features, name, remember(getattr(features, name)))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    global _active
    _active = not item.nodeid.startswith(AFRESH)


def remember(function: Callable[..., Any], most: int = REMEMBERED) -> Callable[..., Any]:
    """The function, whose last `most` different results are kept as bytes: each caller gets arrays of its own."""
    from splatnode.recon.core import current_thread_limit

    found: OrderedDict[bytes, bytes] = OrderedDict()
    lock = threading.Lock()  # of `found`: photographs are worked on by several threads

    def compute(*given: Any) -> Any:
        if not _active:
            return function(*given)
        key = hashlib.sha256(pickle.dumps((given, current_thread_limit()), pickle.HIGHEST_PROTOCOL)).digest()
        with lock:
            known = found.get(key)
            if known is not None:
                found.move_to_end(key)
        if known is None:
            known = pickle.dumps(function(*given), pickle.HIGHEST_PROTOCOL)
            with lock:
                found[key] = known
                if len(found) > most:
                    found.popitem(last=False)
        return pickle.loads(known)

    return compute
