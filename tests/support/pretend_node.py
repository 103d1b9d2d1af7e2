"""What a viewer hears of a node, without one: scenes that are published when a test wants them, and heartbeats."""

from __future__ import annotations

import queue
import threading
import time
from pathlib import Path

from splatnode.capture.messaging.messages import Numbering
from splatnode.capture.messaging.network import RECON_SCENE, RECON_STATUS, Network
from splatnode.capture.messaging.pubsub import Publisher, StateServer
from splatnode.recon.result.message import encode_snapshot
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from tests.support.node import heartbeat

_HEARTBEAT_S = 1.0


class PretendNode:
    """Its sockets lie in `folder`, which has its configuration, too. One thread serves them until `close`."""

    def __init__(self, folder: Path) -> None:
        self.network = Network(directory=folder)
        self.config = folder / "node.yaml"
        self.config.write_text(f"network: {{directory: {folder}}}\n")
        self.tracked: CameraEstimate | None = None
        self._waiting: queue.Queue[tuple[Snapshot, str]] = queue.Queue()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="pretended node", daemon=True)
        self._thread.start()

    def publish(self, snapshot: Snapshot, scene_id: str = "place") -> None:
        self._waiting.put((snapshot, scene_id))

    def close(self) -> None:
        self._closing.set()
        self._thread.join()

    def _serve(self) -> None:
        numbering, beaten = Numbering(), 0.0
        with StateServer(RECON_SCENE, self.network) as server, Publisher(RECON_STATUS, self.network) as heartbeats:
            while not self._closing.is_set():
                while not self._waiting.empty():
                    server.publish(*encode_snapshot(*self._waiting.get(), numbering.next()))
                if time.monotonic() - beaten > _HEARTBEAT_S:
                    beaten = time.monotonic()
                    heartbeats.send(heartbeat(numbering, self.tracked))
                server.serve(0.02)
