"""The splash: a small window that is there at once, while the large one is being opened.

It is a process of its own and needs nothing but Python's tkinter. Where that is missing there is no splash.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Callable, Iterator

from splatnode.capture.process import python

SAYS = "splatnode is opening its window ..."
_SIZE = 420, 120  # pixels
_LOOKS_EVERY_MS = 200  # whether the viewer is still there


@contextlib.contextmanager
def splash() -> Iterator[Callable[[], None]]:
    """Shows the splash until what it yields is called, or until the end."""
    command = python.command("splatnode.viewer.splash")
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def close() -> None:
        child.terminate()
        child.wait()

    try:
        yield close
    finally:
        close()


def main() -> None:
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
    main()
