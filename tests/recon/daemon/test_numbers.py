"""Who counts losses by gaps of `sequence` counts none where nothing was lost: each service has numbers of its own."""

from __future__ import annotations

import threading
from collections import defaultdict
from dataclasses import replace as changed

import numpy as np
from msgspec.structs import replace

from splatnode.capture.messaging.messages import WireError
from splatnode.capture.messaging.pubsub import Publisher, StateServer
from splatnode.recon.daemon import ReconStatus
from splatnode.recon.daemon.free_space import OccupancyConfig as FreeSpace
from splatnode.recon.daemon.free_space import OccupancyResult
from splatnode.recon.daemon.node import Daemon
from splatnode.recon.daemon.output import PublishedSnapshot
from splatnode.recon.daemon.relocalization import FinalScene
from splatnode.recon.occupancy import MapHeader
from splatnode.recon.result.message import SceneHeader
from tests.recon.daemon.test_daemon import config  # noqa: F401
from tests.support.exported import make_snapshot
from tests.support.occupied import small_map


def test_scenes_maps_and_heartbeats_are_each_numbered_without_gaps_in_one_session(config, monkeypatch):  # noqa: F811
    sent, fits, made = defaultdict(list), [True], make_snapshot()
    images = {camera.name: np.zeros((camera.height, camera.width, 3), np.uint8) for camera in made.cameras}

    def publish(_, header, arrays=()):
        if arrays and isinstance(header, MapHeader) and not fits[0]:
            raise WireError("too large")
        sent[type(header)].append(header)

    monkeypatch.setattr(StateServer, "publish", publish)
    monkeypatch.setattr(Publisher, "send", publish)
    with Daemon(replace(config, occupancy=FreeSpace(live=True)), threading.Event()) as daemon:
        for fits[0] in (True, False, True):
            for _ in range(2):
                daemon._heartbeat.send(daemon._make_status())
            shown = PublishedSnapshot(changed(made, images=images), "scene-0001")
            daemon._newest.update(shown)
            daemon._publish()
            daemon._publish_map(OccupancyResult(FinalScene(shown.snapshot, ()), small_map(np.zeros((2, 2, 2)))))
    for kind, count in ((SceneHeader, 3), (MapHeader, 6), (ReconStatus, 6)):
        assert [header.sequence for header in sent[kind]] == list(range(count))
    assert len({header.session for headers in sent.values() for header in headers}) == 1
    maps = [header.map for header in sent[MapHeader]]
    assert [each and each.scene_sequence for each in maps] == [None, 0, None, None, None, 2]
