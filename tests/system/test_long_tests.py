"""Which tests are long: the list, the marker that it gives, and what measures it."""

from __future__ import annotations

import ast
import subprocess
import sys

import pytest

from tests.conftest import ROOT, pytest_collection_modifyitems
from tests.support.long_tests import LIST, LongTest, find_long_test, parse_long_tests, starts_with, sum_long_tests
from tests.support.processor_times import read_times

LONG_TESTS = parse_long_tests(LIST.read_text(encoding="utf-8"))
STARTS = [each.start for each in LONG_TESTS]


def unmatched(starts: list[str]) -> list[str]:
    """Those that name no file with tests, and no test in it. What a parameter in brackets names is not asked."""
    return [start for start in starts if not _tests_of(start)]


def _tests_of(start: str) -> list[str]:
    path, _, name = start.partition("::")
    found = ROOT / "tests" / path
    files = [found] if found.is_file() else sorted(found.rglob("test_*.py")) if found.is_dir() else []
    named = [
        node.name
        for file in files
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    ]
    return [each for each in named if name in ("", each)]


def test_each_line_names_tests_that_there_are():
    assert unmatched(STARTS) == [], f"rename or remove these lines of {LIST.relative_to(ROOT)}"


def test_a_line_without_a_test_is_found():
    wrong = ["system/test_gone.py", "gone/", "system/test_run.py::test_gone", "system/test_run.py::test_"]
    assert unmatched([*wrong, "system/test_tutorial.py", "recon/daemon/"]) == wrong


def test_the_lines_are_in_order_and_none_repeats_another():
    assert sorted(STARTS) == STARTS
    assert [one for one in STARTS for other in STARTS if one != other and starts_with(one, other)] == []
    assert len(set(STARTS)) == len(STARTS)


def test_no_line_has_a_parameter_which_nobody_could_check():
    assert [start for start in STARTS if "[" in start] == []


@pytest.mark.parametrize(
    ("start", "named"),
    [
        ("recon/daemon/", True),
        ("recon/daemon/test_places.py", True),
        ("recon/daemon/test_places.py::test_walk", True),
        ("recon/daemon/test_places.py::test_wa", False),
        ("recon/daemon/test_place", False),
        ("recon/da", False),
        ("recon/daemon/test_places.py::test_walk[other]", False),
        ("daemon/test_places.py", False),
    ],
)
def test_a_start_ends_where_a_name_ends(start, named):
    assert starts_with("recon/daemon/test_places.py::test_walk[two places]", start) == named


def test_a_line_is_a_start_and_seconds():
    text = "# what takes long\n\nrecon/test_cli.py 12\nviewer/test_map.py::test_turn ~1.5\n"
    assert parse_long_tests(text) == (LongTest("recon/test_cli.py", 12), LongTest("viewer/test_map.py::test_turn", 1.5))
    with pytest.raises(ValueError, match="must be START SECONDS.*is 'recon/test_cli.py'"):
        parse_long_tests("recon/test_cli.py\n")


class Item:
    """What pytest collected, by its id."""

    def __init__(self, nodeid: str) -> None:
        self.nodeid = nodeid
        self.markers: list[str] = []

    def add_marker(self, name: str) -> None:
        self.markers.append(name)


def test_the_list_gives_the_marker():
    long, quick = Item(f"tests/{STARTS[0]}"), Item("tests/system/test_sizes.py::test_any")
    pytest_collection_modifyitems([long, quick])
    assert "long" in long.markers and "long" not in quick.markers
    assert find_long_test("system/test_sizes.py::test_any", LONG_TESTS) is None


def test_files_that_take_longest_come_first():
    lines = (
        LongTest("a/test_b.py::test_long", 9.0),
        LongTest("a/test_b.py::test_longer", 11.0),
        LongTest("vm/", 300.0),
    )
    tests = ["a/test_a.py::test_x", "a/test_b.py::test_long[1]", "a/test_b.py::test_long[2]", "vm/test_c.py::test_y"]
    found = {test: find_long_test(test, lines) for test in tests}
    assert sum_long_tests(found) == {"a/test_a.py": 0.0, "a/test_b.py": 9.0, "vm/test_c.py": 300.0}
    names = ["recon/test_pipeline.py::test_any", "system/test_sizes.py::test_any", "vm/test_v4l2.py::test_any"]
    items = [Item(f"tests/{name}") for name in names]
    pytest_collection_modifyitems(items)
    assert [item.nodeid.removeprefix("tests/") for item in items] == [names[2], *names[:2]]


def test_the_processor_time_of_a_test_has_that_of_its_processes(tmp_path):
    work = "import time\nt = time.process_time()\nwhile time.process_time() < t + 0.3: pass\n"
    (tmp_path / "test_one.py").write_text(
        "import subprocess, sys, time\n"
        f"def test_child(): subprocess.run([sys.executable, '-c', {work!r}], check=True)\n"
        "def test_asleep(): time.sleep(0.2)\n"
    )
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    times = tmp_path / "times.tsv"
    command = [sys.executable, "-m", "pytest", "-p", "tests.support.processor_times", f"--processor-times={times}"]
    done = subprocess.run([*command, str(tmp_path)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "processor time: 0.0 minutes of 2 tests" in done.stdout, done.stdout + done.stderr
    (child, first), (asleep, second) = read_times(times.read_text(encoding="utf-8"))
    assert first.endswith("::test_child") and second.endswith("::test_asleep")
    assert child >= 0.3 and asleep < 0.2
