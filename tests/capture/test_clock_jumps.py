"""The wall clock jumps by hours and by centuries while capture works: no keyframe, heartbeat or wait minds it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatnode.capture.messaging.keyframe_queue import KeyframeClient
from splatnode.capture.messaging.network import CAPTURE_STATUS
from splatnode.capture.messaging.pubsub import Subscriber
from splatnode.capture.status import CaptureStatus
from tests.capture.messaging.test_sockets import wait_for
from tests.support.disk_faults import SOURCE, compiled, find_compiler
from tests.support.node import Node, running

COUNT = 12
YEAR_S = 365 * 86400
JUMPS_S = (3600, -3600, 200 * YEAR_S, -60 * YEAR_S, 0)  # Python itself tells no time beyond 2262


@pytest.mark.skipif(find_compiler() is None, reason="needs a compiler for the clock that is preloaded")
def test_capture_minds_no_jump_of_the_wall_clock(tmp_path):
    clock, images = tmp_path / "clock", tmp_path / "images"
    clock.write_text("0")
    images.mkdir()
    camera = {"camera": {"kind": "watched", "folder": str(images), "poll_s": 0.02, "stable_s": 0.05}}
    node = Node(tmp_path / "node", camera | {"selection": {"every_frame": True}})
    preloaded = {"LD_PRELOAD": str(compiled(tmp_path, SOURCE.with_name("wall_clock.c"))), "WALL_CLOCK": str(clock)}
    with running(node), KeyframeClient(node.network) as client:
        process = node.start("capture", **preloaded)
        with Subscriber(CAPTURE_STATUS, node.network, CaptureStatus) as heart:
            uptimes_s = []
            for index in range(COUNT):
                noise = np.random.default_rng(index).integers(0, 256, (30, 40, 3)).astype(np.uint8)
                image = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)
                cv2.imwrite(str(images / f"{index:02d}.png"), image)
                received = wait_for(lambda: client.receive(0.1))
                assert received.frame.name == f"{index:02d}.png"
                client.acknowledge(received)
                clock.write_text(str(JUMPS_S[index % len(JUMPS_S)]))
                if (status := heart.latest(0)) is not None:
                    uptimes_s.append(status.header.uptime_s)
                assert process.poll() is None
            status = wait_for(lambda: heart.latest(2.0))
            assert sorted(uptimes_s) == uptimes_s and 0 < status.header.uptime_s < 600
            wait_for(lambda: node.spooled() == 0)
