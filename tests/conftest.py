"""Fixtures shared by all tests, and which of them are numerical, and which long."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from tests.support.long_tests import LIST, find_long_test, parse_long_tests, sum_long_tests

# As the command line does, before NumPy comes: matrices are small, and the threads of several processes collide.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Tests start hundreds of processes, which would otherwise compile all modules each for itself.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

pytest_plugins = ["tests.support.processor_times", "tests.support.reuse", "tests.support.skip_check"]

ROOT = Path(__file__).resolve().parent.parent

# Where results come from long sums in the compiled core: CI runs these a second time with another order of additions.
NUMERICAL = (
    "extras/evaluate/rivals",
    "recon/matching",
    "recon/optimize",
    "recon/priors",
    "recon/rasterize",
    "recon/registration",
    "recon/result/test_preview",
    "recon/result/test_rendering",
    "recon/scene",
    "recon/test_",
    "recon/verification",
)


def pytest_configure(config: pytest.Config) -> None:
    """Tests are small: threads would wait for each other longer than they work, above all on a busy machine."""
    if config.getoption("dist", "no") == "no":  # the process that hands tests to others runs none
        import torch  # here: children of tests import ROOT, and few of them need torch

        torch.set_num_threads(1)
    # The same examples every time, however slow the machine: a test that fails by chance is no test.
    settings.register_profile("splatnode", deadline=None, derandomize=True, database=None)
    settings.load_profile("splatnode")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Modules and tests stay until the end: to look through them for garbage, again and again, finds none."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    long_tests = parse_long_tests(LIST.read_text(encoding="utf-8"))
    found = {_name(item): find_long_test(_name(item), long_tests) for item in items}
    for item in items:
        if item.nodeid.startswith(tuple(f"tests/{start}" for start in NUMERICAL)):
            item.add_marker("numerical")
        if found[_name(item)]:
            item.add_marker("long")
    # Processes that share the files end at about the same time if the longest come first.
    seconds = sum_long_tests(found)
    items.sort(key=lambda item: -seconds[_name(item).partition("::")[0]])


def _name(item: pytest.Item) -> str:
    return item.nodeid.removeprefix("tests/")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with real scenes, small weights and golden values; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("SPLATNODE_SHARED", ROOT.parent / "shared"))
    if not (folder / "scenes" / "splits.json").exists():
        pytest.skip(f"needs the shared test data (looked in $SPLATNODE_SHARED, then {folder.name}/ beside the project)")
    return folder


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C reaches this process and its children: a background job of a shell inherits it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
