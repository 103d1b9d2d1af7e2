"""A result or a running node in a rerun viewer, which listens already: here, or at the other end of ssh."""

from __future__ import annotations

import contextlib
import socket
import time
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from splatnode.viewer.sources import Source

if TYPE_CHECKING:
    from splatnode.extras.viewers.rerun import RerunRecording

URL = "rerun+http://127.0.0.1:9876/proxy"  # where rerun listens on this machine
_PORT = 9876
_PATIENCE_S = 5.0
_POLL_S = 0.1


class NoRerunViewer(ConnectionError):
    """Nothing listens where the rerun viewer should be."""

    exit_code = 69


def stream(source: Source, url: str = URL) -> None:
    """Sends what comes, until nothing more will.

    Raises ModuleNotFoundError without rerun, ValueError where `url` is none of a rerun viewer, NoRerunViewer, and what
    the source raises.
    """
    from splatnode.extras.viewers import rerun  # takes a second, and is an extra

    _check_listening(url)
    with contextlib.closing(source):
        recording = rerun.connect_viewer(url)
        try:
            follow(source, recording)
        finally:
            recording.flush()


def follow(source: Source, recording: RerunRecording) -> None:
    """Each moment, and each move of the live camera, is a step; returns when nothing more will come."""
    from splatnode.extras.viewers import rerun

    step, tracked, drawn = 0, None, frozenset()
    while True:
        moment = source.take()
        if moment is not None:
            step += 1
            drawn = rerun.draw(recording, moment.snapshot, step, drawn)
        if source.live_camera is not tracked:
            step, tracked = step + 1, source.live_camera
            rerun.draw_tracked(recording, tracked, step)
        if source.age_s is None:
            return
        if moment is None:
            time.sleep(_POLL_S)


def _check_listening(url: str) -> None:
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port or _PORT
    except ValueError:
        host, port = None, _PORT
    if not host or not url.startswith("rerun+http"):
        raise ValueError(f"--rerun-url must be as {URL}, got {url!r}")
    try:
        socket.create_connection((host, port), _PATIENCE_S).close()
    except OSError as error:
        raise NoRerunViewer(
            f"no rerun viewer listens at {host}:{port}. Start one with: rerun. Where that is another machine, let ssh "
            f"lead there: ssh -R {port}:127.0.0.1:{port} ROBOT, from the machine with the viewer"
        ) from error
