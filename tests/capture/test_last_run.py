"""How capture ended is known until the next one begins, and nothing that somebody else wrote is believed."""

from __future__ import annotations

import re

import pytest

from splatnode.capture.messaging.network import Network
from splatnode.capture.status import begin_run, end_run, last_run


@pytest.fixture
def network(tmp_path):
    return Network(directory=tmp_path / "run")


def test_an_end_is_known_until_the_next_run_begins(network):
    assert last_run(network) is None
    end_run(network, frames=40, keyframes=25)
    end_run(network, frames=50, keyframes=25)
    said = r"finished at \d\d:\d\d:\d\d: recon has answered all of its 25 keyframes \(of 50 frames\)"
    assert re.fullmatch(said, str(last_run(network)))
    begin_run(network)
    assert last_run(network) is None


@pytest.mark.parametrize("content", [b"", b"{}", b'{"frames":1,"keyframes":-1,"at_s":0}', b"x" * 2000])
def test_what_is_no_record_of_an_end_tells_nothing(network, content):
    end_run(network, frames=1, keyframes=1)
    (network.directory / "capture.finished").write_bytes(content)
    assert last_run(network) is None
