"""systemd's notification protocol (sd_notify(3)): ready, alive, stopping. Without systemd nothing happens."""

from __future__ import annotations

import os
import re
import socket
import time

from splatnode.capture.process.printable import printable

WATCHDOG_SHARE = 0.25  # of the watchdog's time between two signs of life; sd_watchdog_enabled(3) asks for half at most


class ServiceManager:
    """Tells systemd that the process is ready, alive or stopping. `alive` may be called often and limits its rate."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        usec = os.environ.get("WATCHDOG_USEC", "")
        timeout_s = int(usec) / 1e6 if re.fullmatch("[0-9]{1,18}", usec) else 0.0
        self._every_s = WATCHDOG_SHARE * timeout_s if timeout_s else 1.0
        self._next = 0.0
        self._is_ready = False

    @property
    def is_ready(self) -> bool:
        return self._is_ready

    def ready(self) -> None:
        """Only the first call sends."""
        if not self._is_ready:
            self._is_ready = True
            self._notify("READY=1")

    def alive(self, status: str) -> None:
        """`status` is shown by systemctl status."""
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + self._every_s
            self._notify(f"WATCHDOG=1\nSTATUS={printable(status)}")  # a line break would begin another assignment

    def stopping(self) -> None:
        self._notify("STOPPING=1")

    def _notify(self, message: str) -> None:
        if not self._address:
            return
        address = f"\0{self._address[1:]}" if self._address.startswith("@") else self._address
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as link:
            try:
                link.sendto(message.encode(), address)
            except OSError:
                self._address = ""  # a manager that does not listen is none
