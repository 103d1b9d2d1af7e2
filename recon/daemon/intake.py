"""The thread that receives keyframes: stores, acknowledges, extracts features; it does not wait for the worker."""

from __future__ import annotations

import logging
import threading
import time

from splatnode.capture.messaging.keyframe_messages import ReceivedFrame
from splatnode.capture.messaging.keyframes import KeyframeClient
from splatnode.capture.messaging.network import Network
from splatnode.recon.config import Config
from splatnode.recon.daemon.checkpoint.store import Store, StoredFrame
from splatnode.recon.daemon.inbox import Arrived, Inbox, LeftOut
from splatnode.recon.pipeline import prepare

log = logging.getLogger(__name__)

RECEIVE_S = 0.2  # between looks at whether the daemon stops
RETRY_S = 1.0  # after a frame could not be written


class Intake:
    def __init__(self, network: Network, config: Config, store: Store, inbox: Inbox, stopping: threading.Event) -> None:
        self._network, self._config, self._store, self._inbox = network, config, store, inbox
        self._stopping = stopping
        self.problem = ""
        self.refused = self.duplicates = 0
        self.newest = -1  # number of the last frame that was taken

    def run(self) -> None:
        """Until the daemon stops. Raises NotAllowed."""
        with KeyframeClient(self._network, self._store.seen) as client:
            while not self._stopping.is_set():
                received = client.receive(timeout_s=RECEIVE_S)
                self.refused, self.duplicates = client.refused, client.duplicates
                if received is not None:
                    self._take(client, received)

    def _take(self, client: KeyframeClient, received: ReceivedFrame) -> None:
        arrived_s = time.monotonic()
        while not self._stopping.is_set():
            try:
                stored = self._store.put(received)
            except OSError as error:
                self._complain(f"{received.frame.name} cannot be stored ({error.strerror}): make room on the disk")
                self._stopping.wait(RETRY_S)
                continue
            self.problem = ""
            client.acknowledge(received)
            if stored is None:
                self._inbox.put(LeftOut(received.frame.name), self._stopping)
            else:
                self._hand_over(stored, arrived_s)
            return

    def _hand_over(self, stored: StoredFrame, arrived_s: float) -> None:
        self.newest = stored.number
        try:
            keyframe = prepare(stored.frame, self._config)
        except Exception as error:  # a frame that cannot be used must not stop those that can
            log.exception("%s cannot be used", stored.frame.name)
            self._store.forget(stored.frame.name, f"cannot be used: {error}")
            self._inbox.put(LeftOut(stored.frame.name), self._stopping)
            return
        self._inbox.put(Arrived(keyframe, arrived_s), self._stopping)

    def _complain(self, problem: str) -> None:
        if problem != self.problem:
            log.error("%s", problem)
        self.problem = problem
