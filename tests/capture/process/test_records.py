"""Records are read in several threads at once, of types that nobody has met before."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import msgspec
import pytest

from splatnode.capture.process.config import decoder_of, record_in, record_of
from tests.conftest import ROOT

MEETING = """
import sys, threading
import msgspec
from splatnode.capture.process.config import record_of

sys.setswitchinterval(1e-6)

def kind():
    inner = msgspec.defstruct("Inner", [(f"a{i}", dict[str, list[int]], {}) for i in range(20)])
    middle = msgspec.defstruct("Middle", [(f"b{i}", inner | None, None) for i in range(5)])
    return msgspec.defstruct("Outer", [(f"c{i}", middle | None, None) for i in range(5)])

def meet(gate, outer):
    gate.wait()
    record_of({"c0": {"b0": {"a0": {"x": [1]}}}}, outer)

for _ in range(100):
    told = threading.Barrier(4), kind()
    threads = [threading.Thread(target=meet, args=told) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
print("alive")
"""


class Place(msgspec.Struct, frozen=True):
    name: str
    floors: tuple[int, ...] = ()


class Nested(msgspec.Struct, array_like=True, frozen=True):
    further: Nested | None = None


def test_threads_that_meet_a_type_at_once_do_not_end_the_process():
    done = subprocess.run([sys.executable, "-c", MEETING], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "alive\n", "")


@pytest.mark.parametrize("data", [b'{"name": ' + b"[" * 100_000, b'{"other": ' * 100_000, b'{"\xff": 1}', b'"\xff"'])
def test_a_text_that_no_json_is_has_the_errors_of_json(data):
    with pytest.raises(msgspec.DecodeError):
        record_in(data, Place)
    with pytest.raises(msgspec.DecodeError):
        record_in(data, dict[str, Any])


def test_values_that_are_nested_too_deeply_are_none_of_a_kind():
    deep: Any = 1
    for _ in range(100_000):
        deep = [deep]
    with pytest.raises(msgspec.ValidationError):
        record_of({"name": deep}, dict[str, Nested])


def test_each_way_gives_the_record_and_refuses_what_is_none():
    place = Place("attic", (2, 3))
    assert record_of({"name": "attic", "floors": [2, 3]}, Place) == place
    assert record_in(b'{"name": "attic", "floors": [2, 3]}', Place) == place
    assert decoder_of(Place).decode(msgspec.msgpack.encode(place)) == place
    with pytest.raises(msgspec.ValidationError, match="floors"):
        record_in(b'{"name": "attic", "floors": 2}', Place)
