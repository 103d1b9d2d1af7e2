"""A queue of which every third keyframe is refused: `python -m tests.bench queue --messages 1000`.

The messages lie in capture's spool, as an earlier splatnode may have left them: two of three are good, and the third is
one that recon cannot take, of each kind in turn. Counted: what is delivered and acknowledged, and what is named as
refused. Once between the two ends of the queue in one process, once between the real processes, whose good messages
are six photographs over and over: all six must be in the finished scene, and neither process may have ended.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from splatnode.capture.frame import Frame
from splatnode.capture.messaging.keyframe_queue import KeyframeClient, KeyframeServer, Spool, SpoolConfig
from splatnode.capture.messaging.messages import FrameHeader, Key, Numbering, Part, encode
from splatnode.capture.messaging.network import Network
from splatnode.capture.status import read_heartbeats
from tests.bench.node.trial import RECON, expect, expect_scene
from tests.support.node import Node, running
from tests.support.synthetic import photographs

EVERY = 3  # so manieth message is refused
PATIENCE_S = 900.0
_Header = Callable[[dict[str, Any]], dict[str, Any]]

# What is wrong with a refused message: of its header, or of the parts.
_HEADERS: dict[str, _Header] = {
    "a stamp of 5e18": lambda header: header | {"stamp_ns": 5 * 10**18},
    "a negative stamp": lambda header: header | {"stamp_ns": -1},
    "a frame id of 64 bits": lambda header: header | {"frame_id": 2**63},
    "a field too many": lambda header: header | {"extra": 1},
    "a number as text": lambda header: header | {"stamp_ns": "1"},
    "a lens without length": lambda header: header | {"intrinsics": dict.fromkeys(("width", "height"), 0)},
}
_SHAPES: dict[str, tuple[str, list[int]]] = {
    "no pixels, and no end of them": ("u1", [0, 2**62, 4]),
    "pixels of four bytes": ("f4", [6, 8, 3]),
    "more pixels than bytes": ("u1", [2**31, 2**31, 3]),
}
KINDS = (*_HEADERS, *_SHAPES)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/queue.json"))
    args = parser.parse_args()
    result = {"command": shlex.join(["python", "-m", "tests.bench", "queue", *sys.argv[1:]])}
    for name, run in (("two ends", two_ends), ("processes", processes)):
        with tempfile.TemporaryDirectory() as folder:
            row = run(Path(folder), args.messages)
        print(name, json.dumps(row), flush=True)
        result |= {name.replace(" ", "_"): row}
    args.out.write_text(json.dumps(result, indent=1) + "\n")


def fill(spool: Spool, count: int, images: Sequence[Frame]) -> list[str]:
    """Puts the messages into the spool; the names of those that will be refused."""
    numbering, refused = Numbering(), []
    for index in range(count):
        image = images[(index - len(refused)) % len(images)]
        name = f"{index:04d}_{image.name}"
        header = FrameHeader(**numbering.next(), frame_id=index, name=name, stamp_ns=index, intrinsics=None)
        message = encode(header, [image.image])
        if index % EVERY == EVERY - 1:
            message = _spoiled(message, KINDS[index // EVERY % len(KINDS)])
            refused.append(name)
        spool.store(Key(header.session, header.sequence), message)
    return refused


def _spoiled(message: list[Part], kind: str) -> list[Part]:
    magic, head, image = message
    header, table = msgspec.msgpack.decode(head)
    if kind in _SHAPES:
        return [magic, msgspec.msgpack.encode([header, [_SHAPES[kind]]]), b""]
    return [magic, msgspec.msgpack.encode([_HEADERS[kind](header), table]), image]


def two_ends(folder: Path, count: int) -> dict[str, Any]:
    """KeyframeServer and KeyframeClient."""
    network, started = Network(directory=folder / "run"), time.monotonic()
    spool = Spool(SpoolConfig(directory=folder / "state", max_frames=count))
    images = [Frame(0, f"{index}.png", 0, np.full((6, 8, 3), index, np.uint8), None) for index in range(7)]
    refused, taken = fill(spool, count, images), []
    with KeyframeServer(network, spool) as server, KeyframeClient(network) as client:
        while server.num_queued and time.monotonic() < started + PATIENCE_S:
            server.serve(0.001)
            if (received := client.receive(0.001)) is not None:
                taken.append(received.frame.name)
                client.acknowledge(received)
        named = {each.name for each in spool.quarantine.newest(count)}
        return _row(count, refused, named, started) | {
            "delivered_once": len(taken) == len(set(taken)) == count - len(refused),
            "acknowledged": server.acknowledged,
            "left": server.num_queued,
            "refused_by_recon": client.refused,
        }


def processes(folder: Path, count: int) -> dict[str, Any]:
    """`splatnode capture` and `splatnode recon`. Raises AssertionError where one ends, or a photograph is missing."""
    images = photographs()
    (folder / "empty").mkdir()
    camera = {"camera": {"kind": "watched", "folder": str(folder / "empty")}}
    started = time.monotonic()
    with running(Node(folder / "node", camera, RECON)) as node:
        with contextlib.closing(Spool(SpoolConfig(directory=node.folder, max_frames=count, max_mb=4096))) as spool:
            refused = fill(spool, count, images)
        for verb in ("recon", "capture"):
            node.start(verb)
        while node.spooled():
            expect(time.monotonic() < started + PATIENCE_S, f"{node.spooled()} keyframes are left")
            expect(all(each.poll() is None for each in node.processes.values()), "a process ended")
            time.sleep(0.2)
        expect_scene(node, len(images))
        said = read_heartbeats(node.network)
        named = set(re.findall(r"set aside (\S+):", node.log("capture")))
        codes = {verb: node.end(verb) for verb in ("capture", "recon")}
    capture, recon = (said[room] or {} for room in ("capture", "recon"))
    return _row(count, refused, named, started) | {
        "photographs_in_the_scene": len(images),
        "acknowledged": capture.get("acknowledged"),
        "left": capture.get("waiting"),
        "refused_by_recon": recon.get("refused"),
        "capture_tells": capture.get("problem"),
        "recon_tells": recon.get("problem"),
        "newest_set_aside": capture.get("newest_set_aside"),
        "exit_codes": codes,
    }


def _row(count: int, refused: list[str], named: set[str], started: float) -> dict[str, Any]:
    return {
        "messages": count,
        "refused": len(refused),
        "refused_and_named": len(named & set(refused)),
        "named_and_good": len(named - set(refused)),
        "kinds": len(KINDS),
        "seconds": round(time.monotonic() - started, 1),
    }


if __name__ == "__main__":
    main()
