"""The thread that receives previews, so that the newest is at hand however seldom and slowly previews are examined."""

from __future__ import annotations

import logging
import threading

from splatnode.capture.messaging.broadcast import Subscriber
from splatnode.capture.messaging.network import Network, NotAllowed
from splatnode.capture.messaging.services import CAPTURE_PREVIEW
from splatnode.capture.messaging.wire import Message
from splatnode.capture.preview import PreviewHeader
from splatnode.capture.process.problems import Problems, is_logged

log = logging.getLogger(__name__)

READ_S = 0.05  # between reads: a queue that is full keeps the oldest, and this one holds what a second brings
RETRY_S = 1.0  # after the connection failed


class PreviewReceiver:
    """The newest preview. One thread runs `run`, another takes."""

    def __init__(self, network: Network, problems: Problems, stopping: threading.Event) -> None:
        self._network, self._problems, self._stopping = network, problems, stopping
        self._lock = threading.Lock()
        self._newest: Message[PreviewHeader] | None = None
        self._refused = 0
        self._unconnected = ""  # why none come

    def take(self) -> Message[PreviewHeader] | None:
        """The newest preview, once; None where none has come since. Never waits."""
        with self._lock:
            newest, self._newest = self._newest, None
            return newest

    def run(self) -> None:
        """Until the daemon stops. A connection that fails is made anew: the other end may have been put right."""
        while not self._stopping.is_set():
            try:
                with Subscriber(CAPTURE_PREVIEW, self._network, PreviewHeader) as subscriber:
                    self._receive(subscriber)
            except NotAllowed:  # which the keyframes' connection tells, too
                self._stopping.wait(RETRY_S)
            except Exception as error:  # a key's file, for one, may be written just now
                self._report_unconnected(error)
                self._stopping.wait(RETRY_S)

    def _receive(self, subscriber: Subscriber) -> None:
        """Raises NotAllowed."""
        self._unconnected = ""
        before = self._refused
        while not self._stopping.wait(READ_S):
            newest = subscriber.latest(0)
            self._refused = before + subscriber.refused
            self._problems.count("previews that were refused", self._refused, subscriber.why_refused)
            if newest is not None:
                with self._lock:
                    self._newest = newest

    def _report_unconnected(self, error: Exception) -> None:
        """Once, however long it lasts."""
        why = f"{type(error).__name__}: {error}"
        if why == self._unconnected:
            return
        self._unconnected = why
        if is_logged(self._problems.add("failures of the previews' connection", why)):
            log.error("the connection that previews come by failed", exc_info=error)
