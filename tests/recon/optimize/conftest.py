"""Who computes: the compiled core, or torch as on a GPU."""

from __future__ import annotations

import pytest

from splatnode.recon import rasterize


@pytest.fixture(params=["core", "torch"])
def computed_by(request, monkeypatch) -> str:
    """Runs a test twice: with what serves on the processor, and with what serves elsewhere."""
    if request.param == "torch":
        monkeypatch.setattr(rasterize, "is_on_cpu", lambda tensor: False)
    return request.param
