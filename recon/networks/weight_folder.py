"""Where the weights of the optional networks lie on this machine. The default reconstruction needs none of them."""

from __future__ import annotations

import os
from pathlib import Path

from splatnode.capture.process.state_directory import home


class WeightsError(ValueError):
    """Weights that are not there, or not what they should be; the message says what to do."""


def folder() -> Path:
    """Where weights are put: $SPLATNODE_WEIGHTS, else splatnode/weights among the user's data."""
    named = os.environ.get("SPLATNODE_WEIGHTS")
    if named:
        return Path(named)
    data = os.environ.get("XDG_DATA_HOME") or home("SPLATNODE_WEIGHTS") / ".local" / "share"
    return Path(data) / "splatnode" / "weights"


def located(path: str) -> Path | None:
    """The file `path` in `folder()`, or beside a checkout of the project where developers keep them; else None."""
    developers = Path(__file__).resolve().parents[3] / "shared" / "weights"
    places = [folder()] if "SPLATNODE_WEIGHTS" in os.environ else [folder(), developers]
    return next((place / path for place in places if (place / path).is_file()), None)


def find(path: str) -> Path:
    """The file `path` as the catalogue names it. Raises WeightsError where it is not there."""
    found = located(path)
    if found is None:
        name = Path(path).stem
        raise WeightsError(f"no weights {path} in {folder()}: splatnode weights fetch {name}, or list for its source")
    return found
