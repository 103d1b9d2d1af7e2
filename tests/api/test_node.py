"""A connection to a node: its scenes as they come, its live camera, and an end."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

import splatnode
from tests.support.exported import make_camera, make_snapshot
from tests.support.pretend_node import PretendNode

PATIENCE_S = 30.0


@pytest.fixture
def node(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir(mode=0o700)
    pretended = PretendNode(folder)
    yield pretended
    pretended.close()


def scene():
    made = make_snapshot()
    return replace(made, images={camera.name: np.zeros((48, 64, 3), np.uint8) for camera in made.cameras})


def test_updates_come_as_the_scene_changes(node, tmp_path):
    with splatnode.connect(node.network.directory) as connection:
        assert connection.wait(0.05) is None and connection.live_camera is None
        node.publish(scene(), "kitchen")
        update = connection.wait(PATIENCE_S)
        assert update is not None and update.scene_id == "kitchen"
        assert update.result.verdict.code.value == "OK" and len(update.result.gaussians["means"]) == 50
        assert [camera.name for camera in update.result.cameras] == ["0000.jpg", "0002.jpg"]
        assert connection.silent_s < PATIENCE_S
        camera = update.result.cameras[0]
        assert update.result.render(camera.T_world_camera, camera.K, (64, 48)).rgb.shape == (48, 64, 3)
        again = splatnode.load(update.result.save(tmp_path / "saved"))
        assert len(again.cameras) == 2


def test_the_live_camera_is_asked_for(node):
    node.tracked = make_camera(7)
    with splatnode.connect(node.config) as connection:
        node.publish(scene())
        assert connection.wait(PATIENCE_S) is not None
        waiting = threading.Event()
        for _ in range(int(PATIENCE_S * 10)):
            if connection.live_camera is not None:
                break
            waiting.wait(0.1)
        found = connection.live_camera
        assert found is not None and np.allclose(found.T_world_camera, node.tracked.T_world_camera)


def test_who_iterates_ends_when_another_thread_closes(node):
    connection = splatnode.connect(node.network.directory)
    node.publish(scene())
    heard = []

    def listen() -> None:
        for update in connection:
            heard.append(update.scene_id)

    listener = threading.Thread(target=listen)
    listener.start()
    while not heard and listener.is_alive():
        listener.join(0.05)
    connection.close()
    listener.join(PATIENCE_S)
    assert heard == ["place"] and not listener.is_alive()
    connection.close()  # a second time does no harm


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("192.168.1.7",), "keys must be the folder that `splatnode keygen` made, to connect to 192.168.1.7; got None"),
        (("/nowhere/at/all",), "is no folder and no .yaml file"),
        (("nowhere.yaml",), "nowhere.yaml: No such file"),
    ],
)
def test_an_address_that_is_none_is_told(arguments, said):
    with pytest.raises(ValueError, match=said):
        splatnode.connect(*arguments)
