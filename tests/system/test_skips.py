"""`--check-skips`: a skip fails a run unless it is on the list, with its reason."""

from __future__ import annotations

import os
import subprocess
import sys
from fnmatch import fnmatch

import pytest

from tests.conftest import ROOT
from tests.support.allowed_skips import ALLOWED

FILES = {
    "unknown": "import pytest\ndef test_it():\n    pytest.skip('did not feel like it')\n",
    "whole_file": "import pytest\npytest.skip('did not feel like it', allow_module_level=True)\n",
    "photographs": "import pytest\ndef test_it():\n    pytest.skip('needs the shared test data (looked around)')\n",
    "expected": "import pytest\n@pytest.mark.xfail\ndef test_it():\n    assert False\n",
}


def run(folder, kind: str, *options: str) -> subprocess.CompletedProcess[str]:
    (folder / "test_one.py").write_text(FILES[kind] + "def test_another(): pass\n")
    (folder / "pytest.ini").write_text("[pytest]\n")
    command = [sys.executable, "-m", "pytest", "-p", "tests.support.skip_check", *options, str(folder)]
    plain = os.environ | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}  # others' plug-ins take longer than the tests
    return subprocess.run(command, cwd=ROOT, env=plain, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("kind", "options", "code"),
    [
        ("unknown", ["--check-skips="], 1),
        ("unknown", ["--check-skips=shared,open3d"], 1),
        ("unknown", [], 0),
        ("photographs", ["--check-skips="], 1),
        ("photographs", ["--check-skips=shared,open3d"], 0),
        ("expected", ["--check-skips="], 0),
    ],
)
def test_a_skip_that_is_not_on_the_list_fails_the_run(tmp_path, kind, options, code):
    done = run(tmp_path, kind, *options)
    assert done.returncode == code, done.stdout + done.stderr
    assert ("test_one.py::test_it: " in done.stdout) == (code == 1)


def test_a_whole_file_that_skips_fails_the_run(tmp_path):
    done = run(tmp_path, "whole_file", "--check-skips=")
    assert done.returncode != 0 and "did not feel like it" in done.stdout


def test_what_a_machine_may_lack_is_on_the_list(tmp_path):
    done = run(tmp_path, "photographs", "--check-skips=time")
    assert done.returncode != 0 and "knows no time" in done.stderr


def test_every_allowed_skip_has_a_reason_of_its_own_words():
    assert all(row.why and row.test for row in ALLOWED)
    assert all(row.said != "*" or row.lacking for row in ALLOWED)


def test_every_row_is_of_a_test_file_that_there_is():
    files = [path.relative_to(ROOT / "tests").as_posix() for path in (ROOT / "tests").rglob("test_*.py")]
    gone = [row.test for row in ALLOWED if "/" in row.test and not any(fnmatch(file, row.test) for file in files)]
    assert not gone, f"no test file is there for {gone}: did it move?"
