"""The option `--check-skips` of pytest: fails a run in which a test skips that `allowed_skips` does not allow."""

from __future__ import annotations

import pytest

from tests.support.allowed_skips import is_allowed, unknown_names


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--check-skips",
        nargs="?",
        const="",
        metavar="LACKING",
        help="fail when a test skips that tests/support/allowed_skips.py does not allow; LACKING: what this machine "
        "cannot have, with commas between",
    )


def pytest_configure(config: pytest.Config) -> None:
    named = config.getoption("check_skips")
    if named is None:
        return
    lacking = frozenset(name for name in named.split(",") if name)
    if unknown := unknown_names(lacking):
        raise pytest.UsageError(f"--check-skips knows no {', '.join(sorted(unknown))}")
    config.pluginmanager.register(SkipCheck(lacking))


class SkipCheck:
    """Notes every skip, of a test or of a whole file."""

    def __init__(self, lacking: frozenset[str]) -> None:
        self._lacking = lacking
        self._refused: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._note(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        self._note(report)

    def _note(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        if report.skipped and isinstance(report.longrepr, tuple):  # an expected failure is told otherwise
            said = str(report.longrepr[2]).removeprefix("Skipped: ")
            if not is_allowed(report.nodeid.removeprefix("tests/"), said, self._lacking):
                self._refused.append(f"{report.nodeid}: {said}")

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self._refused and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if self._refused:
            terminalreporter.section("skips that tests/support/allowed_skips.py does not allow")
            for line in self._refused:
                terminalreporter.line(line)
