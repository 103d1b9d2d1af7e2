"""A result in the window of `splatnode view`, in a process of its own.

Open3D wants a process's main thread, and ends the process where it finds no Vulkan driver: a program keeps its own.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from typing import TYPE_CHECKING

from splatnode.viewer.probe import open3d_installed, probe_window

if TYPE_CHECKING:
    from splatnode.api.result import Result

VIEWER = (sys.executable, "-m", "splatnode", "view")


def show(result: Result, command: tuple[str, ...] = VIEWER) -> None:
    """Returns when the window is closed. Raises ModuleNotFoundError without Open3D, RuntimeError without a window."""
    if not open3d_installed():
        raise ModuleNotFoundError("the window needs Open3D. Run: pip install 'splatnode[viewer]'", name="open3d")
    probe = probe_window()
    if not probe.window:
        raise RuntimeError(
            f"no window can be opened: {probe.detail}. In a browser: result.save(DIR), then splatnode view DIR --web"
        )
    with tempfile.TemporaryDirectory(prefix="splatnode-") as folder:
        result.save(folder)
        child = subprocess.run([*command, folder], capture_output=True, text=True, errors="replace")
    if child.returncode:
        raise RuntimeError(f"the viewer ended with exit code {child.returncode}: {child.stderr.strip()[-1000:]}")
