"""The table of services: every message between the processes belongs to one of them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Pattern(Enum):
    QUEUE = "ROUTER binds, DEALER connects: acknowledged, nothing is lost"
    BROADCAST = "PUB binds, SUB connects: newest wins, losses are counted"
    STATE = "PUB and ROUTER bind, SUB and DEALER connect: newest wins, late subscribers ask for it"
    COMMANDS = "ROUTER binds, DEALER connects: request and reply"


@dataclass(frozen=True)
class Service:
    name: str
    pattern: Pattern
    tcp_port: int  # counted from the first port of the network

    @property
    def requests(self) -> Service:
        """Returns the service on which late subscribers ask for the state; it has a socket of its own."""
        return Service(f"{self.name}.requests", self.pattern, self.tcp_port + 1)


CAPTURE_KEYFRAMES = Service("capture.keyframes", Pattern.QUEUE, 0)
CAPTURE_PREVIEW = Service("capture.preview", Pattern.BROADCAST, 1)
CAPTURE_STATUS = Service("capture.status", Pattern.BROADCAST, 2)
RECON_SCENE = Service("recon.scene", Pattern.STATE, 3)  # and 4, for requests
RECON_STATUS = Service("recon.status", Pattern.BROADCAST, 5)
RECON_CONTROL = Service("recon.control", Pattern.COMMANDS, 6)
CAPTURE_CONTROL = Service("capture.control", Pattern.COMMANDS, 7)
RECON_MAP = Service("recon.map", Pattern.STATE, 8)  # and 9, for requests; where it is configured
RECON_DEPTH = Service("recon.depth", Pattern.STATE, 10)  # and 11, for requests
