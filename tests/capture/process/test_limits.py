"""A process that may not have what it needs says so, before a library ends it."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.conftest import ROOT

NUMBERS = (*range(6, 48, 3), 64, 128)
STARTS = """
import json, os, resource, sys, tempfile
from pathlib import Path
from splatnode.capture.messaging.pubsub import Publisher
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.network import RECON_STATUS
from splatnode.capture.process.system import LimitTooLow

def start(number):
    resource.setrlimit(resource.RLIMIT_NOFILE, (number, number))
    with tempfile.TemporaryDirectory() as folder:
        try:
            Publisher(RECON_STATUS, Network(directory=Path(folder) / "run")).close()
        except LimitTooLow as error:
            return str(error)
        except OSError as error:
            return error.strerror
        return "works"

for number in map(int, sys.argv[1:]):
    if not (child := os.fork()):
        print(json.dumps([number, start(number)]), flush=True)
        os._exit(0)
    print(json.dumps([number, os.waitpid(child, 0)[1]]), flush=True)
"""


@pytest.fixture(scope="module")
def said() -> dict[int, str]:
    """What a child of one process said with each number of descriptors."""
    command = [sys.executable, "-c", STARTS, *map(str, NUMBERS)]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    lines = [json.loads(line) for line in ran.stdout.splitlines()]
    assert [value for _, value in lines if isinstance(value, int)] == [0] * len(NUMBERS), lines  # libzmq aborts
    return {number: value for number, value in lines if isinstance(value, str)}


@pytest.mark.parametrize("number", NUMBERS)
def test_with_any_number_of_descriptors_an_endpoint_works_or_says_why_not(said, number):
    why = said[number]
    assert why == "works" if number >= 64 else "ulimit -n" in why or "Too many open files" in why or why == "works"
