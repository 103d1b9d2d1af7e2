"""Which tests are long: the lines of long_tests.txt. `./run test` runs the others, `./run test --all` runs all.

A line is a folder, a file or a test, from tests/ on, and the processor seconds that it takes, its processes included.
`./run test --processor-times=FILE` measures them. Seconds with a `~` before are estimated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

LIST = Path(__file__).with_name("long_tests.txt")


class LongTest(NamedTuple):
    start: str  # of a test's id: recon/test_cli.py, or recon/test_cli.py::test_help
    processor_s: float


def parse_long_tests(text: str) -> tuple[LongTest, ...]:
    """The lines `START SECONDS`; empty lines and what follows a `#` at a line's start are left out."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return tuple(_parse_line(line) for line in lines)


def _parse_line(line: str) -> LongTest:
    start, _, seconds = line.rpartition(" ")
    try:
        return LongTest(start.strip(), float(seconds.removeprefix("~")))
    except ValueError:
        raise ValueError(
            f"a line of {LIST.name} must be START SECONDS, such as `recon/test_cli.py::test_help 12`, is {line!r}"
        ) from None


def starts_with(test: str, start: str) -> bool:
    """Whether the test's id, from tests/ on, is `start`, or lies in the folder, file or test of that name."""
    rest = test.removeprefix(start)
    return len(rest) < len(test) and (not rest or start.endswith("/") or rest.startswith(("::", "[")))


def find_long_test(test: str, long_tests: Iterable[LongTest]) -> LongTest | None:
    """The line that makes a test a long one; None: it is quick. `test` is its id from tests/ on."""
    return next((each for each in long_tests if starts_with(test, each.start)), None)


def sum_long_tests(found: Mapping[str, LongTest | None]) -> dict[str, float]:
    """The processor seconds of each file's long tests, by the line of each test; a folder's count for all its files."""
    lines: dict[str, set[LongTest]] = {}
    for test, line in found.items():
        lines.setdefault(test.partition("::")[0], set()).update([line] if line else [])
    return {file: sum(each.processor_s for each in named) for file, named in lines.items()}
