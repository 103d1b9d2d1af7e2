"""Where the weights of the optional networks lie on this machine. The default reconstruction needs none of them."""

from __future__ import annotations

import os
from pathlib import Path
from stat import S_ISLNK, S_IWOTH

from splatnode.capture.process.state_directory import home


class WeightsError(ValueError):
    """Weights that are not there, or not what they should be; the message says what to do."""


def folder() -> Path:
    """Returns the folder of the weights: $SPLATNODE_WEIGHTS, else splatnode/weights among the user's data."""
    named = os.environ.get("SPLATNODE_WEIGHTS")
    if named:
        return Path(named)
    data = os.environ.get("XDG_DATA_HOME") or home("SPLATNODE_WEIGHTS") / ".local" / "share"
    return Path(data) / "splatnode" / "weights"


def locate_weights(path: str) -> Path | None:
    """The file `path` in `folder()`, or beside a checkout of the project where developers keep them; else None.

    A checkout may lie in a folder into which everybody writes, such as /tmp: what somebody else put beside it is not
    looked at.
    """
    if (folder() / path).is_file():
        return folder() / path
    checkout = Path(__file__).resolve().parents[2]
    beside = checkout.parent / "shared" / "weights" / path
    if "SPLATNODE_WEIGHTS" in os.environ or not beside.is_file():
        return None
    return beside if _are_of_whoever_wrote_the_code(checkout, beside) else None


def _are_of_whoever_wrote_the_code(checkout: Path, weights: Path) -> bool:
    """Whether nobody else can have put them there: the file, and the folders above it that are beside the checkout."""
    trusted = {0, os.geteuid(), checkout.stat().st_uid}
    ways = [weights, *weights.parents]
    found = [stat for each in ways[: ways.index(checkout.parent)] for stat in (each.lstat(), each.stat())]
    return all(each.st_uid in trusted and (S_ISLNK(each.st_mode) or not each.st_mode & S_IWOTH) for each in found)


def find(path: str) -> Path:
    """The file `path` as the catalogue names it. Raises WeightsError where it is not there."""
    found = locate_weights(path)
    if found is None:
        name = Path(path).stem
        raise WeightsError(f"no weights {path} in {folder()}: splatnode weights fetch {name}, or list for its source")
    return found
