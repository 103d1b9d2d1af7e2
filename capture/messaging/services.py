"""The table of services: all that the processes say to each other goes through one of these."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Pattern(Enum):
    QUEUE = "ROUTER binds, DEALER connects: acknowledged, nothing is lost"
    BROADCAST = "PUB binds, SUB connects: newest wins, losses are counted"
    STATE = "PUB and ROUTER bind, SUB and DEALER connect: newest wins, whoever comes late asks for it"
    COMMANDS = "ROUTER binds, DEALER connects: a question and its answer"


@dataclass(frozen=True)
class Service:
    name: str
    pattern: Pattern
    tcp_port: int  # counted from the first port of the network

    @property
    def requests(self) -> Service:
        """Where late comers ask for a state; it has its own socket."""
        return Service(f"{self.name}.requests", self.pattern, self.tcp_port + 1)


CAPTURE_KEYFRAMES = Service("capture.keyframes", Pattern.QUEUE, 0)
CAPTURE_PREVIEW = Service("capture.preview", Pattern.BROADCAST, 1)
CAPTURE_STATUS = Service("capture.status", Pattern.BROADCAST, 2)
RECON_SCENE = Service("recon.scene", Pattern.STATE, 3)  # and 4, for requests
RECON_STATUS = Service("recon.status", Pattern.BROADCAST, 5)
RECON_CONTROL = Service("recon.control", Pattern.COMMANDS, 6)
