"""A million malformed messages: `python -m tests.bench fuzz --messages 1000000 --out tests/bench/results/fuzz.json`.

Three quarters go to the decoders, the rest to open sockets of every kind: well-formed ZeroMQ messages with rubbish in
them over ipc, and raw bytes on the tcp ports. Good messages are changed by flipped bytes, cuts, doubled and swapped
parts, changed lengths; others are chance. A message that decodes must encode to what it was, and must keep its limits.
After each batch a good message must still get through. Memory is read at the end of each tenth: the first one warms
up, and what counts is the growth from the second to the last.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import time
from pathlib import Path
from typing import Any

from splatnode.capture.messaging.wire import Limits, Message, WireError, decode, encode
from splatnode.capture.preview import PreviewHeader, decode_preview
from splatnode.capture.process.memory import resident_mb
from tests.bench.node.attacked import TENTHS, fuzz_ports, fuzz_sockets
from tests.bench.node.malformed import Parts, good_messages, malformed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    rng = random.Random(args.seed)
    start = time.monotonic()
    result: dict[str, Any] = {"command": f"python -m tests.bench fuzz --messages {args.messages} --seed {args.seed}"}
    result["decoders"] = fuzz_decoders(rng, args.messages * 3 // 4)
    result["ipc_sockets"] = fuzz_sockets(rng, args.messages - args.messages * 3 // 4)
    result["tcp_ports"] = fuzz_ports(rng, connections=max(10, args.messages // 2000))
    result["messages"] = sum(result[name]["messages"] for name in ("decoders", "ipc_sockets"))
    result["refused"] = result["decoders"]["refused"] + sum(result["ipc_sockets"]["refused"].values())
    result["seconds"] = time.monotonic() - start
    print(json.dumps(result, indent=1))
    if args.out:
        args.out.write_text(json.dumps(result, indent=1) + "\n")


def fuzz_decoders(rng: random.Random, count: int) -> dict[str, Any]:
    goods = good_messages()
    limits = Limits(header_bytes=1 << 16, arrays=8, total_bytes=1 << 20)
    accepted = refused = unchanged = 0
    memory = []
    for index in range(count):
        good, schema = goods[index % len(goods)]
        parts = malformed(rng, good)
        try:
            message = decode(parts, schema, limits)
        except WireError:
            refused += 1
        else:
            accepted += 1
            unchanged += parts == good
            assert_consistent(message, parts, schema, limits)
        if (index + 1) % (count // TENTHS) == 0:
            memory.append(resident_mb())
    for good, schema in goods:
        decode(good, schema, limits)
    return {
        "messages": count,
        "refused": refused,
        "still_of_their_schema": accepted,  # a changed pixel, name or number
        "of_these_unchanged": unchanged,
        "errors_other_than_refusal": 0,  # any would have ended the run
        "rss_mb": memory,
        "growth_mb": memory[-1] - memory[1],
    }


def assert_consistent(message: Message[Any], parts: Parts, schema: Any, limits: Limits) -> None:
    """What was accepted keeps the limits and means the same when it is sent on."""
    if sum(map(len, parts)) > limits.total_bytes or len(message.arrays) > limits.arrays:
        raise AssertionError(f"limits broken by {parts!r}")
    again = decode([bytes(part) for part in encode(message.header, message.arrays)], schema, limits)
    if repr(again.header) != repr(message.header) or [a.tobytes() for a in again.arrays] != parts[2:]:
        raise AssertionError(f"not what it was: {parts!r}")
    if schema is PreviewHeader:
        with contextlib.suppress(WireError):
            decode_preview(message)


if __name__ == "__main__":
    main()
