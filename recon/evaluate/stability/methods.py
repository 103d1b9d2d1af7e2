"""What goes through the matrix: splatnode by its public entry point, and stock reconstructions beside it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.pipeline import reconstruct, reconstruct_stream
from splatnode.recon.result.snapshot import Snapshot

Method = Callable[[Iterable[Frame | DroppedFrame], ReconstructionConfig], Snapshot]

NAMES = ("splatnode", "colmap", "glomap")


def splatnode(frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig) -> Snapshot:
    """The last snapshot."""
    (last,) = deque(reconstruct(frames, config), maxlen=1)
    return last


def splatnode_stream(frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig) -> Snapshot:
    """The last snapshot of frames that come one at a time."""
    (last,) = deque(reconstruct_stream(frames, config), maxlen=1)
    return last


def find_method(name: str, stream: bool = False) -> Method:
    """The method; `stream`: for frames that come one at a time, if it can.

    Raises ValueError for a method that there is not, or that needs a package that is not installed.
    """
    if name == "splatnode":
        return splatnode_stream if stream else splatnode
    if name not in NAMES:
        raise ValueError(f"no method {name!r}; there are: {', '.join(NAMES)}")
    try:
        from splatnode.recon.evaluate.stability import stock
    except ImportError as error:
        raise ValueError(f"method {name!r} needs pycolmap. Run: pip install 'splatnode[bench]'") from error
    return stock.colmap if name == "colmap" else stock.glomap
