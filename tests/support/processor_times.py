"""The option `--processor-times=FILE` of pytest: writes what each test costs, in processor seconds.

A row is `SECONDS TAB ID`. The seconds are of user and system, of the process and of the children that ended meanwhile.
A fixture that several tests share counts for the first, or for the last where it ends its processes. A busy machine
changes these seconds little, as opposed to those of `--durations`.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path

import pytest

SHOWN = 10  # slowest tests in the summary


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--processor-times",
        metavar="FILE",
        help="write the processor seconds of each test to FILE, and show their sum and the slowest tests",
    )


def pytest_configure(config: pytest.Config) -> None:
    if (named := config.getoption("processor_times")) is None:
        return
    path = Path(named).absolute()
    if hasattr(config, "workerinput"):  # a process of xdist
        config.pluginmanager.register(ProcessorTimes(path))
        return
    path.write_text("", encoding="utf-8")
    config.pluginmanager.register(ProcessorTimes(path))
    config.pluginmanager.register(Summary(path))


class ProcessorTimes:
    """Appends a row for each test. Several processes append to one file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        before = processor_seconds()
        result = yield
        with self._path.open("a", encoding="utf-8") as file:
            file.write(f"{processor_seconds() - before:.2f}\t{item.nodeid}\n")
        return result  # pyright: ignore[reportReturnType]


class Summary:
    """Shows the sum and the slowest tests at the end."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        rows = read_times(self._path.read_text(encoding="utf-8"))
        total = sum(seconds for seconds, _ in rows)
        terminalreporter.section(f"processor time: {total / 60:.1f} minutes of {len(rows)} tests")
        for seconds, test in sorted(rows, reverse=True)[:SHOWN]:
            terminalreporter.line(f"{seconds:.1f} s {test}")


def processor_seconds() -> float:
    """User and system seconds of this process and of its children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def read_times(text: str) -> list[tuple[float, str]]:
    """The rows of a file that `--processor-times` wrote: seconds and ids."""
    rows = [line.split("\t", 1) for line in text.splitlines()]
    return [(float(seconds), test) for seconds, test in rows]
