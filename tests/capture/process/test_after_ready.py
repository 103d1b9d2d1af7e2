"""The codes that keep a unit from starting again are those of a start that failed."""

from __future__ import annotations

import re

import pytest

from splatnode import command_line
from splatnode.capture.frame import CameraUnavailable
from splatnode.capture.messaging.network import KeyFileError, NotAllowed
from splatnode.capture.process.system import FailedAfterReady, ServiceManager, wrap_late_errors
from tests.conftest import ROOT

ERRORS = [ValueError("a"), NotAllowed("b"), KeyFileError("c"), FileNotFoundError(2, "d"), PermissionError(13, "e"),
          OSError(28, "f"), RecursionError(), MemoryError(), CameraUnavailable("g")]  # fmt: skip


@pytest.fixture
def final() -> set[int]:
    """Exit codes after which the units start nothing."""
    units = list((ROOT / "configs" / "systemd").glob("*.service"))
    assert len(units) == 2
    return {int(code) for unit in units
            for code in re.search("RestartPreventExitStatus=(.*)", unit.read_text())[1].split()}  # fmt: skip


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_no_error_after_ready_needs_a_human(error, final):
    manager = ServiceManager()
    with pytest.raises(type(error)), wrap_late_errors(manager):
        raise error
    manager.ready()
    with pytest.raises((FailedAfterReady, CameraUnavailable, MemoryError)) as caught, wrap_late_errors(manager):
        raise error
    assert command_line.exit_code(caught.value) not in final


def test_a_clean_end_is_one(final):
    manager = ServiceManager()
    manager.ready()
    with pytest.raises(SystemExit), wrap_late_errors(manager):
        raise SystemExit(0)
    assert 0 not in final
