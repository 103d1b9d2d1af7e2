"""Which recon gets capture's keyframes: one at a time, for each frame is given away once.

The one that is served stays until it has been silent for a while. Its own next process takes over at once: both have
the id of their checkpoint. Of two processes with one id, which are a checkpoint and its copy, the later one stays.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field

from splatnode.capture.messaging.keyframe_messages import Ready
from splatnode.capture.messaging.spool import Key

SILENT_S = 5.0  # after which another recon is served; one that lives asks twice a second
FORGET_S = 20.0  # without a request, a connection counts as gone
MOST_CONNECTIONS = 64
_ENDED = 16  # processes whose successor has come


@dataclass
class Connection:
    """One connection. What was sent over it arrives, or the connection ends."""

    identity: bytes
    recon: str
    process: str
    heard_s: float  # monotonic
    capacity: int = 0
    message_bytes: int = 0
    outstanding: set[Key] = field(default_factory=set)  # sent or held, neither acknowledged nor refused


class ConsumerArbiter:
    """The connections, and which of them is served."""

    def __init__(self) -> None:
        self._connections: dict[bytes, Connection] = {}
        self._served: Connection | None = None
        self._ended: deque[str] = deque(maxlen=_ENDED)

    @property
    def active(self) -> Connection | None:
        return self._served

    @property
    def num_rejected(self) -> int:
        """Recons that ask and are not served."""
        return len({each.process for each in self._connections.values() if not self._is_active(each)})

    def is_active(self, identity: bytes) -> bool:
        return self._served is not None and self._served.identity == identity

    def handle_ready(self, identity: bytes, request: Ready, spooled: Collection[Key], now_s: float) -> bool:
        """A recon asks for keyframes: whether it gets them."""
        known = self._connections.get(identity)
        if known is None and len(self._connections) >= MOST_CONNECTIONS:
            self.remove_connection(min(self._connections.values(), key=self._eviction_rank).identity)
        asking = known or Connection(identity, request.recon, request.process, now_s)
        self._connections[identity] = asking
        asking.recon, asking.process, asking.heard_s = request.recon, request.process, now_s
        asking.capacity, asking.message_bytes = request.capacity, request.message_bytes
        asking.outstanding |= {key for pair in request.holding if (key := Key(*pair)) in spooled}
        if self._takes_over(asking, now_s):
            before, self._served = self._served, asking
            if before is not None and before.process != asking.process:
                self._handle_takeover(before, asking)
        return self._served is asking

    def record_keep_alive(self, identity: bytes, now_s: float) -> None:
        """The connection has said something."""
        if identity in self._connections:
            self._connections[identity].heard_s = now_s

    def mark_answered(self, key: Key) -> None:
        """The frame is no longer on its way."""
        for each in self._connections.values():
            each.outstanding.discard(key)

    def forget_silent(self, now_s: float) -> None:
        for identity in [name for name, each in self._connections.items() if now_s - each.heard_s > FORGET_S]:
            self.remove_connection(identity)

    def remove_connection(self, identity: bytes) -> None:
        """The connection has ended."""
        self._connections.pop(identity, None)
        if self.is_active(identity):
            self._served = None

    def _handle_takeover(self, before: Connection, after: Connection) -> None:
        """Another process is served now. One with the same checkpoint has ended: if it is a copy, it asks again."""
        self._ended.append(before.process)
        if before.recon == after.recon:
            for identity in [name for name, each in self._connections.items() if each.process == before.process]:
                self.remove_connection(identity)

    def _eviction_rank(self, connection: Connection) -> tuple[bool, float]:
        """The least goes where there are too many, so that nobody can keep others out by asking often."""
        return self.is_active(connection.identity), connection.heard_s

    def _is_active(self, connection: Connection) -> bool:
        return self._served is not None and self._served.process == connection.process

    def _takes_over(self, asking: Connection, now_s: float) -> bool:
        served = self._served
        if served is None or served is asking:
            return True
        if now_s - served.heard_s > SILENT_S or served.process == asking.process:
            return True
        return served.recon == asking.recon and asking.process not in self._ended
