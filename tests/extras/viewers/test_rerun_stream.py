"""`splatnode view --rerun`: each update is a step of the recording, and a viewer that is not there is told of."""

from __future__ import annotations

import socket
from dataclasses import replace

import pytest

from splatnode.extras.viewers.rerun_stream import NoRerunViewer, _check_listening, follow
from splatnode.viewer.state import Moment
from tests.support.exported import make_camera, make_snapshot


class Node:
    """Two updates, of which the second has a camera less; then the live camera is found, and the node ends."""

    def __init__(self) -> None:
        first = make_snapshot()
        self._moments = [Moment(first, 0.0), Moment(replace(first, cameras=first.cameras[:1]), 1.0)]
        self.live_camera = None

    def take(self):
        if self._moments:
            return self._moments.pop(0)
        self.live_camera = make_camera(7)
        return None

    @property
    def age_s(self):
        return None if self.live_camera is not None else 0.0

    def close(self) -> None: ...


def test_each_update_is_a_step_in_which_what_was_before_is_gone(tmp_path):
    rerun = pytest.importorskip("rerun", reason="needs rerun")
    chunks = pytest.importorskip("rerun.chunk", reason="needs rerun")
    recording = rerun.RecordingStream("test")
    recording.save(str(tmp_path / "live.rrd"))
    follow(Node(), recording)
    recording.disconnect()
    steps: dict[str, set[int]] = {}
    cleared: dict[str, list[int]] = {}
    for chunk in chunks.RrdReader(str(tmp_path / "live.rrd")).stream():
        batch = chunk.to_record_batch()
        if "step" in batch.schema.names:
            found = batch.column("step").to_pylist()
            steps.setdefault(chunk.entity_path, set()).update(found)
            if any(name.startswith("Clear:") for name in batch.schema.names):
                cleared[chunk.entity_path] = found
    assert steps["/world/cameras/0000.jpg"] == {1, 2} and steps["/world/cameras/0002.jpg"] == {1, 2}
    assert steps["/world/gaussians"] == steps["/verdict"] == {1, 2}
    assert cleared == {"/world/cameras/0002.jpg": [2]}
    assert steps["/world/live_camera"] == {3}


def test_a_viewer_that_is_not_there_is_told_of():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        port = taken.getsockname()[1]
        with pytest.raises(NoRerunViewer, match=f"no rerun viewer listens at 127.0.0.1:{port}. Start one with: rerun"):
            _check_listening(f"rerun+http://127.0.0.1:{port}/proxy")
        taken.listen()
        _check_listening(f"rerun+http://127.0.0.1:{port}/proxy")


@pytest.mark.parametrize("url", ["127.0.0.1:9876", "http://127.0.0.1:9876", "rerun+http://x:port/proxy", "rerun+http:"])
def test_what_is_no_address_of_a_rerun_viewer_is_refused(url):
    with pytest.raises(ValueError, match="--rerun-url must be as rerun"):
        _check_listening(url)
