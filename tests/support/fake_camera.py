"""A camera that is there for a test: a module in a folder that `capture/cameras` is made to have."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from splatnode.capture import cameras


@contextmanager
def fake_camera(name: str, source: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A configuration, in `folder`, of the camera `name` whose module's text is `source`."""
    (folder / "cameras").mkdir()
    (folder / "cameras" / f"{name}.py").write_text(source)
    monkeypatch.setattr(cameras, "__path__", [*cameras.__path__, str(folder / "cameras")])
    (folder / f"{name}.yaml").write_text(f"camera: {{kind: {name}}}")
    try:
        yield folder / f"{name}.yaml"
    finally:
        sys.modules.pop(f"splatnode.capture.cameras.{name}", None)
        if hasattr(cameras, name):
            delattr(cameras, name)
