"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with real scenes, small weights and golden values; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("SPLATNODE_SHARED", ROOT.parent / "shared"))
    if not (folder / "scenes" / "splits.json").exists():
        pytest.skip(f"needs the shared test data (looked in $SPLATNODE_SHARED, then {folder.name}/ beside the project)")
    return folder
