"""What a stranger shouts at a tcp port, before any message: chance, other protocols, greetings with rubbish behind."""

from __future__ import annotations

import contextlib
import random
import socket

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00"  # ZMTP 3.0 begins so


def shout(rng: random.Random, port: int) -> int:
    """A connection with raw bytes: chance, old protocols, HTTP, a greeting with rubbish after it; their number."""
    data = rng.choice(
        (
            rng.randbytes(rng.randrange(1, 3000)),
            b"\x01\x00\x06\x00hello" * 20,
            b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n",
            GREETING + b"NULL" + bytes(16) + b"\x00" + bytes(31) + b"\x04\x19\x05READY" + rng.randbytes(50),
            GREETING + b"CURVE" + bytes(15) + b"\x00" + bytes(31) + rng.randbytes(300),
        )
    )
    with socket.create_connection(("127.0.0.1", port), timeout=5) as stranger, contextlib.suppress(OSError):
        stranger.sendall(data)
        if rng.random() < 0.2:
            stranger.settimeout(0.02)
            stranger.recv(1000)
    return len(data)
