"""A result in a viewer, which is a process of its own: in a window, in rerun's, or in a browser.

Open3D wants a process's main thread, and ends the process where it finds no Vulkan driver: a program keeps its own.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from splatnode.capture.process import python
from splatnode.capture.process.system import remedy
from splatnode.viewer.probe import open3d_installed, probe_window

if TYPE_CHECKING:
    from splatnode.api.result import Result

Viewer = Literal["open3d", "rerun", "browser", "viser"]

_RERUN = ("rerun", "--bind", "127.0.0.1", "--port", "auto")  # by itself it listens everywhere
_OPTIONS = {"open3d": (), "browser": ("--web",), "viser": ("--viser",)}  # of `splatnode view`
_IN_BROWSER = ("browser", "viser")
_ELSEWHERE = "In a browser: result.show('browser')"
_END_S = 10.0  # for a viewer to end, before it is killed


def show(
    result: Result,
    viewer: Viewer = "open3d",
    *,
    listen: str | None = None,
    port: int | None = None,
    opened: Callable[[str], object] = print,
    command: tuple[str, ...] | None = None,
) -> None:
    """As `Result.show`. `command` shows what it gets as its last argument; None: what the viewer is."""
    if viewer not in get_args(Viewer):
        raise ValueError(f"viewer must be one of {', '.join(get_args(Viewer))}; got {viewer!r}")
    if viewer not in _IN_BROWSER and (listen is not None or port is not None):
        raise ValueError(f"listen and port are of {' and '.join(_IN_BROWSER)}; {viewer} opens a window on this machine")
    if not result.verdict.publishable:
        raise ValueError(f"there is no scene to show: {result.verdict.code.value}. Ask verdict.publishable first")
    _check(viewer)
    given = {"--listen": listen, "--port": port}
    options = [part for name, value in given.items() if value is not None for part in (name, str(value))]
    with tempfile.TemporaryDirectory(prefix="splatnode-") as folder:
        shown = result.save(folder)
        if viewer == "rerun":
            _run((*(command or python.command(*_RERUN)), str(_export_rrd(shown))), opened=None)
        else:
            whole = (*(command or python.command("splatnode", "view")), *_OPTIONS[viewer], *options, folder)
            _run(whole, opened if viewer in _IN_BROWSER else None)


def _check(viewer: Viewer) -> None:
    """Raises ModuleNotFoundError without what the viewer needs, RuntimeError where it can open no window."""
    if viewer == "open3d":
        if not open3d_installed():
            raise ModuleNotFoundError(f"the window needs Open3D. {remedy('open3d')}", name="open3d")
        probe = probe_window()
        if not probe.window:
            raise RuntimeError(f"no window can be opened: {probe.detail}. {_ELSEWHERE}")
    elif viewer in ("rerun", "viser"):
        if find_spec(viewer) is None:
            raise ModuleNotFoundError(f"the viewer {viewer} is not installed. {remedy(viewer)}", name=viewer)
        if viewer == "rerun" and sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
            raise RuntimeError(
                f"rerun's window cannot be opened: there is no display ($DISPLAY or $WAYLAND_DISPLAY). {_ELSEWHERE}"
            )


def _export_rrd(folder: Path) -> Path:
    """Exports the result in the folder as `splatnode export --to rrd` does."""
    from splatnode.recon.result.export import export_scene

    return export_scene(folder, "rrd")


def _run(command: tuple[str, ...], opened: Callable[[str], object] | None) -> None:
    """Until the viewer ends, or Ctrl-C ends it. `opened` gets each line that it says.

    Raises RuntimeError where it fails, and what `opened` raises.
    """
    with tempfile.TemporaryFile() as errors:
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, errors="replace")
        assert child.stdout is not None
        try:
            for line in child.stdout:
                if opened is not None:
                    opened(line.strip())
            code = child.wait()
        except KeyboardInterrupt:
            return
        finally:
            _end(child)
            child.stdout.close()
        if code:
            errors.seek(0)
            said = errors.read().decode(errors="replace").strip()[-1000:]
            raise RuntimeError(f"the viewer ended with exit code {code}: {said}")


def _end(child: subprocess.Popen[str]) -> None:
    """As Ctrl-C does, which `python -m rerun` hands on to the window; killed where that does not do."""
    if child.poll() is not None:
        return
    child.send_signal(signal.SIGINT)
    try:
        child.wait(_END_S)
    except subprocess.TimeoutExpired:
        pass
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()
