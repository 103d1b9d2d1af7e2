"""Processes beside a window: one finds out whether it can be opened here, one says meanwhile that it opens."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from splatnode.capture.process import python

# Whether a window can be opened here, found out in a child process, which opens a small one and says so.
#
# Open3D ends the whole process, without an exception, where it finds no Vulkan driver, and opens a window that nobody
# can see where it finds no display. So a child tries first, and what becomes of it is the answer.

TIMEOUT_S = 60.0
_SOFTWARE = ("llvmpipe", "lavapipe", "swiftshader", "software")


@dataclass(frozen=True)
class Probe:
    window: bool
    software: bool  # Vulkan runs on the processor: Open3D's splats take a second a picture
    detail: str  # the device, or why there is no window and what to do

    @property
    def size(self) -> tuple[int, int]:
        """Width and height to open a window with: the processor pays for each pixel of every picture."""
        return (1120, 700) if self.software else (1280, 800)


def probe_window(command: Sequence[str] | None = None, timeout_s: float = TIMEOUT_S) -> Probe:
    """Tries to open a window in a child process: `command`, or else this module. It never raises for what it finds."""
    trial = command or python.command("splatnode.viewer.probe")
    try:
        child = subprocess.run(trial, capture_output=True, text=True, errors="replace", timeout=timeout_s)
    except subprocess.TimeoutExpired:
        return Probe(False, False, f"opening a window took more than {timeout_s:.0f} s")
    output = child.stdout + child.stderr
    if "headless mode" in output or "GLFW error" in output:  # it opens a window that nobody can see
        return Probe(False, False, "there is no display ($DISPLAY or $WAYLAND_DISPLAY)")
    if child.returncode != 0 or "splatnode-window-opened" not in output:
        return Probe(False, False, _reason(output, child.returncode))
    device = re.search(r"Selected physical device '([^']*)'", output)
    name = device.group(1) if device else "an unnamed device"
    return Probe(True, any(word in name.lower() for word in _SOFTWARE), name)


def open3d_installed() -> bool:
    return importlib.util.find_spec("open3d") is not None


def _reason(output: str, code: int) -> str:
    """Why the child failed, by what it said last."""
    said = output.lower()
    missing = re.search(r"ImportError: (lib\S+): cannot open shared object", output)
    if missing:
        return f"Open3D needs {missing.group(1)}, which this system lacks; install it with the system's package manager"
    if "importerror" in said or "modulenotfounderror" in said:
        return f"Open3D cannot be imported: {_last_line(output)}"
    if "unable to open x11 display" in said:
        return "there is no display ($DISPLAY or $WAYLAND_DISPLAY)"
    if "vulkan" in said:
        return "there is no Vulkan driver; on Debian and Ubuntu: apt-get install mesa-vulkan-drivers libvulkan1"
    return f"Open3D could not open a window (exit status {code}): {_last_line(output)}"


def _last_line(output: str) -> str:
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return lines[-1][:200] if lines else "it said nothing"


def open_trial_window() -> None:
    """Ends this process."""
    from open3d.visualization import gui, rendering  # pyright: ignore[reportMissingImports]

    app = gui.Application.instance
    app.initialize()
    window = app.create_window("splatnode", 64, 64)
    widget = gui.SceneWidget()
    widget.scene = rendering.Open3DScene(window.renderer)
    window.add_child(widget)
    for _ in range(3):
        app.run_one_tick()
    print("splatnode-window-opened", flush=True)
    os._exit(0)


# The splash: a small window that is there at once, while the large one is being opened.
#
# It is a process of its own and needs nothing but Python's tkinter. Where that is missing there is no splash.

SAYS = "splatnode is opening its window ..."
_SIZE = 420, 120  # pixels
_LOOKS_EVERY_MS = 200  # whether the viewer is still there


@contextlib.contextmanager
def splash() -> Iterator[Callable[[], None]]:
    """Shows the splash until what it yields is called, or until the end."""
    command = python.command("splatnode.viewer.probe", "splash")
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def close() -> None:
        child.terminate()
        child.wait()

    try:
        yield close
    finally:
        close()


def show_splash() -> None:
    """Shows the splash until it is told to end, or until the process that asked for it has ended."""
    import tkinter
    from tkinter import ttk

    parent = os.getppid()
    root = tkinter.Tk(className="splatnode-splash")
    root.title(SAYS)
    root.configure(background="#181a1e")
    left, top = (root.winfo_screenwidth() - _SIZE[0]) // 2, (root.winfo_screenheight() - _SIZE[1]) // 2
    root.geometry(f"{_SIZE[0]}x{_SIZE[1]}+{left}+{top}")
    tkinter.Label(root, text=SAYS, foreground="#e6e6e6", background="#181a1e").pack(expand=True)
    bar = ttk.Progressbar(root, mode="indeterminate", length=_SIZE[0] - 80)
    bar.pack(pady=(0, 30))
    bar.start()

    def look() -> None:
        if os.getppid() != parent:
            root.destroy()
        else:
            root.after(_LOOKS_EVERY_MS, look)

    look()
    root.mainloop()


if __name__ == "__main__":
    show_splash() if sys.argv[1:] == ["splash"] else open_trial_window()
