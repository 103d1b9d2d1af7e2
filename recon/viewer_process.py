"""A viewer beside an offline run: a process of its own that gets the newest snapshot whenever it is ready for one."""

from __future__ import annotations

import contextlib
import json
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from splatnode.capture.messaging.messages import Numbering
from splatnode.capture.messaging.network import RECON_DEPTH, RECON_SCENE, Network
from splatnode.capture.messaging.pubsub import StateServer
from splatnode.capture.process import python
from splatnode.recon.result.message import encode_snapshot, make_depth_header
from splatnode.recon.result.snapshot import Snapshot

Show = Callable[[Snapshot], None]

_SERVE_S = 0.05


@contextlib.contextmanager
def viewer(pictures: Path, command: Sequence[str] | None = None) -> Iterator[Show]:
    """Starts a viewer and gives the function that shows it a snapshot; at the end, waits until it is closed.

    Showing never waits: a snapshot that the viewer has not taken is replaced by the next. Where no window can be
    opened, the viewer keeps a picture in the folder `pictures` up to date and closes itself after the last snapshot.
    `command` begins a viewer; None: the verb view.
    """
    begin = command or python.command("splatnode", "view")
    with tempfile.TemporaryDirectory(prefix="splatnode-") as folder:
        config = Path(folder, "node.yaml")
        config.write_text(json.dumps({"network": {"directory": folder}}))  # YAML, whatever the folder's name is
        with _SnapshotServer(Network(directory=Path(folder))) as stage:
            child = subprocess.Popen([*begin, str(config), "--exit-when-final", "--out", str(pictures)])
            try:
                yield stage.show
                child.wait()
            finally:
                child.terminate()
                child.wait()


class _SnapshotServer:
    """Publishes the newest of the snapshots that it is shown, and answers a viewer that comes late, in a thread."""

    def __init__(self, network: Network) -> None:
        self._server = StateServer(RECON_SCENE, network)
        self._depths = StateServer(RECON_DEPTH, network)
        self._newest: Snapshot | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._serve, name="audience", daemon=True)

    def __enter__(self) -> _SnapshotServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing = True
        self._thread.join()
        self._server.close()
        self._depths.close()

    def show(self, snapshot: Snapshot) -> None:
        self._newest = snapshot

    def _serve(self) -> None:
        numbering = Numbering()
        depth_numbering = Numbering(numbering.session)
        published = None
        while not self._closing:
            newest = self._newest
            if newest is not None and newest is not published:
                numbers, session = numbering.next(), numbering.session
                self._depths.publish(make_depth_header(newest, session, numbers["sequence"], depth_numbering.next()))
                self._server.publish(*encode_snapshot(newest, session, numbers))
                published = newest
            self._depths.serve(0)
            self._server.serve(_SERVE_S)
