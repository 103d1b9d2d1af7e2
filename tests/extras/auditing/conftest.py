from __future__ import annotations

from pathlib import Path

import pytest

from splatnode.recon.result.stored_snapshot import LANDMARKS, encode_landmarks
from tests.support.located import known_place


@pytest.fixture(scope="session")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result folder of the built-in capture, as far as an audit reads it."""
    folder = tmp_path_factory.mktemp("out")
    (folder / LANDMARKS).write_bytes(encode_landmarks(known_place().landmarks))
    return folder
