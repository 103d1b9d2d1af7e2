"""A process that may not have what it needs says so, before a library ends it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import ROOT

STARTS = """
import resource, sys, tempfile
from pathlib import Path
from splatnode.capture.messaging.pubsub import Publisher
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.network import RECON_STATUS
from splatnode.capture.process.system import LimitTooLow
number = int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_NOFILE, (number, number))
with tempfile.TemporaryDirectory() as folder:
    try:
        Publisher(RECON_STATUS, Network(directory=Path(folder) / "run")).close()
    except LimitTooLow as error:
        print(error)
    except OSError as error:
        print(f"{error.strerror}")
    else:
        print("works")
"""


@pytest.mark.parametrize("number", [*range(6, 48, 3), 64, 128])
def test_with_any_number_of_descriptors_an_endpoint_works_or_says_why_not(number):
    ran = subprocess.run([sys.executable, "-c", STARTS, str(number)], cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr  # libzmq aborts
    said = ran.stdout.strip()
    assert said == "works" if number >= 64 else "ulimit -n" in said or "Too many open files" in said or said == "works"
