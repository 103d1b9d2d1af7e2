"""A browser without a window, driven over its DevTools pipe as a person would: mouse, keys, and a look at the page."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

NAMES = ("chromium", "chromium-browser", "google-chrome")
_PATIENCE_S = 60.0  # for an answer
_BUTTONS = {"left": 1, "right": 2}
# The browser's pipe is at descriptors 3 and 4, whatever numbers its ends have here.
_AT_3_AND_4 = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(end), fcntl.F_DUPFD, 10) for end in sys.argv[1:3]]
for end, number in zip(ends, (3, 4)):
    os.dup2(end, number)
os.execv(sys.argv[3], sys.argv[3:])
"""


def chromium() -> str | None:
    """The browser's path; None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page. What the DevTools protocol is asked goes out through one pipe, and answers come through another."""

    def __init__(self, pid: int, out: int, back: int) -> None:
        self.pid = pid
        self._out, self._back, self._rest, self._number = out, back, b"", 0
        self.complaints: list[str] = []  # errors of the page
        target = self._ask("Target.createTarget", url="about:blank")["targetId"]
        self._session: str | None = self._ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.ask(f"{domain}.enable")

    def ask(self, method: str, **parameters: object) -> dict[str, Any]:
        """What the browser answers, of the page. Raises RuntimeError where it refuses, TimeoutError."""
        return self._ask(method, self._session, **parameters)

    def resize(self, width: int, height: int) -> None:
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def open(self, url: str) -> None:
        """Goes there; what is asked from then on is answered by the new page."""
        self.value("window.left = true")
        self.ask("Page.navigate", url=url)
        self.wait("!window.left")

    def value(self, expression: str) -> Any:
        """What JavaScript says."""
        answer = self.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait(self, expression: str, patience_s: float = _PATIENCE_S) -> float | None:
        """Seconds until JavaScript says that it is so; None where it never does."""
        began = time.monotonic()
        while time.monotonic() < began + patience_s:
            with contextlib.suppress(RuntimeError):  # the page is being loaded
                if self.value(expression):
                    return time.monotonic() - began
            time.sleep(0.05)
        return None

    def picture(self) -> npt.NDArray[np.uint8]:
        """(H, W, 3) BGR of the page."""
        data = base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])
        return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), np.uint8)

    def mouse(self, kind: str, x: float, y: float, button: str = "none", **more: object) -> None:
        held = _BUTTONS.get(button, 0) if kind != "mouseReleased" else 0
        self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=held, **more)

    def click(self, x: float, y: float, button: str = "left") -> None:
        self.mouse("mouseMoved", x, y)
        self.mouse("mousePressed", x, y, button, clickCount=1)
        self.mouse("mouseReleased", x, y, button, clickCount=1)

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: str = "left", steps: int = 10) -> None:
        self.mouse("mouseMoved", *start)
        self.mouse("mousePressed", *start, button, clickCount=1)
        for x, y in np.linspace(start, end, steps + 1)[1:].tolist():
            self.mouse("mouseMoved", x, y, button)
        self.mouse("mouseReleased", *end, button, clickCount=1)

    def wheel(self, x: float, y: float, pixels: float) -> None:
        self.mouse("mouseWheel", x, y, deltaX=0, deltaY=pixels)

    def press(self, key: str) -> None:
        self.ask("Input.dispatchKeyEvent", type="keyDown", key=key, text=key)
        self.ask("Input.dispatchKeyEvent", type="keyUp", key=key)

    def processor_s(self) -> float:
        """Seconds of processor time that the browser's processes have taken, those that have ended left out."""
        stats: dict[int, tuple[int, int]] = {}  # by process: its parent, and its time in ticks
        for path in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                fields = path.read_text().rpartition(")")[2].split()
                stats[int(path.parent.name)] = int(fields[1]), int(fields[11]) + int(fields[12])
        family = {self.pid}
        while grown := {pid for pid, (parent, _) in stats.items() if parent in family} - family:
            family |= grown
        return sum(stats[pid][1] for pid in family if pid in stats) / os.sysconf("SC_CLK_TCK")

    def _ask(self, method: str, session: str | None = None, **parameters: object) -> dict[str, Any]:
        self._number += 1
        message: dict[str, object] = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + _PATIENCE_S
        while True:
            answer = self._read(deadline)
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self._note(answer)

    def _read(self, deadline: float) -> dict[str, Any]:
        while b"\0" not in self._rest:
            if not select.select([self._back], [], [], max(0.0, deadline - time.monotonic()))[0]:
                raise TimeoutError(f"the browser did not answer within {_PATIENCE_S:g} s")
            part = os.read(self._back, 1 << 20)
            if not part:
                raise RuntimeError("the browser has ended")
            self._rest += part
        message, self._rest = self._rest.split(b"\0", 1)
        return json.loads(message)

    def _note(self, event: dict[str, Any]) -> None:
        if event.get("method") == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(event["params"]["exceptionDetails"])[:500])
        elif event.get("method") == "Log.entryAdded" and event["params"]["entry"]["level"] == "error":
            entry = event["params"]["entry"]
            self.complaints.append(f"{entry['text']} {entry.get('url', '')}")


@contextlib.contextmanager
def browser(width: int, height: int) -> Iterator[Browser]:
    """A page of that size. Raises FileNotFoundError where there is no browser."""
    path = chromium()
    if path is None:
        raise FileNotFoundError(f"none of {', '.join(NAMES)} is installed")
    ours_in, theirs_out = os.pipe()
    theirs_in, ours_out = os.pipe()
    with tempfile.TemporaryDirectory(prefix="splatnode-", ignore_cleanup_errors=True) as profile:
        command = [sys.executable, "-c", _AT_3_AND_4, str(theirs_in), str(theirs_out), path, "--headless=new"]
        command += ["--remote-debugging-pipe", f"--user-data-dir={profile}", "--no-sandbox", "--no-first-run"]
        command += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"]
        process = subprocess.Popen(
            command, pass_fds=(theirs_in, theirs_out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(theirs_in)
        os.close(theirs_out)
        try:
            page = Browser(process.pid, ours_out, ours_in)
            page.resize(width, height)
            yield page
        finally:
            os.close(ours_out)  # the browser ends with its pipe
            os.close(ours_in)
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
