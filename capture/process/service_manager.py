"""systemd's notification protocol (sd_notify(3)): ready, alive, stopping. Without systemd nothing happens."""

from __future__ import annotations

import os
import re
import socket
import time

from splatnode.capture.process.printable import sanitize_text

WATCHDOG_SHARE = 0.25  # of the watchdog's time between two signs of life; sd_watchdog_enabled(3) asks for half at most


class ServiceManager:
    """Tells systemd that the process is ready, alive or stopping. `alive` may be called often and limits its rate."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        usec = os.environ.get("WATCHDOG_USEC", "")
        timeout_s = int(usec) / 1e6 if re.fullmatch("[0-9]{1,18}", usec) else 0.0
        self._every_s = WATCHDOG_SHARE * timeout_s if timeout_s else 1.0
        self._next = 0.0
        self._is_ready = self._knows_ready = False

    @property
    def is_ready(self) -> bool:
        return self._is_ready

    def ready(self) -> None:
        """Only the first call sends; `alive` goes on with that until it has gone out."""
        if not self._is_ready:
            self._is_ready = True
            self._knows_ready = self._notify("READY=1")

    def alive(self, status: str) -> None:
        """`status` is shown by systemctl status."""
        if self._is_ready and not self._knows_ready:
            self._knows_ready = self._notify("READY=1")
        # A line break would begin another assignment.
        if time.monotonic() >= self._next and self._notify(f"WATCHDOG=1\nSTATUS={sanitize_text(status)}"):
            self._next = time.monotonic() + self._every_s

    def stopping(self) -> None:
        self._notify("STOPPING=1")

    def _notify(self, message: str) -> bool:
        """False where it is worth another time: the manager is busy, or this process has no descriptor to spare."""
        if not self._address:
            return True
        address = f"\0{self._address[1:]}" if self._address.startswith("@") else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as link:
                link.sendto(message.encode(), address)
        except (FileNotFoundError, ConnectionRefusedError):
            self._address = ""  # a manager that does not listen is none
        except OSError:
            return False
        return True
