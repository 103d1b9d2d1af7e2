"""Images of a program of one's own get to recon as a camera's do: acknowledged, kept on the disk, bounded, shown."""

from __future__ import annotations

import re
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

import splatnode
from splatnode.capture.config import PreviewHeader, decode_preview
from splatnode.capture.frame import Clock, Stamp
from splatnode.capture.keyframe_selection import Config
from splatnode.capture.messaging.keyframe_queue import KeyframeClient
from splatnode.capture.messaging.network import CAPTURE_PREVIEW, Network
from splatnode.capture.messaging.pubsub import Subscriber
from splatnode.capture.status import read_heartbeats
from tests.capture.messaging.test_sockets import wait_for
from tests.conftest import ROOT

POSE = np.array([[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]])
STEP = np.eye(4)
STEP[:3, 3] = 0.1, 0.0, 0.0


def picture(index=0, width=320, height=240):
    noise = np.random.default_rng(index).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def changes(folder, **further):
    return {"network": {"directory": folder / "run"}, "spool": {"directory": folder / "state"}, **further}


def publisher(folder, **options):
    return splatnode.Publisher(every_frame=True, **{"changes": changes(folder), **options})


def recon(folder, **options):
    return KeyframeClient(Network(directory=folder / "run"), **options)


def receive(client, count):
    """Acts as recon until it has so many frames, which it acknowledges."""
    found = []
    while len(found) < count:
        received = wait_for(lambda: client.receive(0.05), 10.0)
        client.acknowledge(received)
        found.append(received.frame)
    return found


def test_an_image_arrives_with_all_that_the_program_knows_of_it(tmp_path):
    image, mask = picture(), np.ones((240, 320), bool)
    mask[:60] = False
    lens = splatnode.Intrinsics(640, 480, 600, 600, 320, 240, "calibration")
    with publisher(tmp_path, camera_id="left") as node, recon(tmp_path, camera_id="left") as client:
        first = node.publish(image, name="first", captured_at=1.5, intrinsics=lens, pose=POSE, gravity=(0, 1, 0))
        image[:] = 0  # the program may write to it again
        second = node.publish(picture(1), mask=mask, motion=STEP, motion_sigma=(0.01, 1.0), camera_id="left")
        third = node.publish(cv2.imencode(".jpg", picture(2))[1].tobytes(), camera_id="wrist")
        assert first == splatnode.Published("first", True, "every frame is taken") and second.taken and third.taken
        frames = receive(client, 3)
        assert node.flush(10.0) and (node.num_waiting, node.num_acknowledged, node.is_connected) == (0, 3, True)
    assert np.array_equal(frames[0].image, picture()) and frames[0].captured_at == Stamp(1_500_000_000, Clock.UTC)
    assert frames[0].intrinsics is not None and frames[0].intrinsics.fx == 300 and frames[0].gravity.down == (0, 1, 0)
    assert np.array_equal(frames[0].given_pose.matrix, POSE) and frames[0].given_pose.sigma_m == 0.01
    assert frames[1].mask.mean() == 0.75 and not frames[1].mask[0].any() and frames[1].name.startswith("left_")
    assert frames[1].motion.chain == frames[0].motion.chain == "first" and frames[1].motion.sigma_m == 0.01
    assert np.allclose(frames[1].motion.matrix, STEP)
    assert [frame.camera_id for frame in frames] == ["left", "left", "wrist"]
    assert frames[0].stamp_ns < frames[1].stamp_ns < frames[2].stamp_ns


def test_previews_and_the_heartbeat_are_a_cameras(tmp_path):
    network = Network(directory=tmp_path / "run")
    with publisher(tmp_path) as node, Subscriber(CAPTURE_PREVIEW, network, PreviewHeader) as previews:
        numbers = iter(range(1000))
        shown = wait_for(lambda: node.publish(picture(next(numbers))) and previews.latest(0.02), 10.0)
        assert decode_preview(shown).shape == (240, 320, 3) and shown.header.state == "streaming"
        found = wait_for(lambda: (beat := read_heartbeats(network, 0.5)["capture"]) and beat["frames"] and beat, 10.0)
    assert found["camera"] == "program" and found["state"] == "streaming" and found["keyframes"] == found["waiting"]


def test_keyframes_are_selected_as_a_cameras_for_each_camera_on_its_own(tmp_path):
    with splatnode.Publisher(changes=changes(tmp_path)) as node:
        assert node.publish(picture(0), camera_id="left").reason == "first view of this stream"
        assert node.publish(picture(1), camera_id="right").reason == "first view of this stream"
        time.sleep(2.0 / Config().max_fps)  # until an image is examined, of no frame set before
        again = node.publish(picture(0), camera_id="left")
        assert not again.taken and again.reason.startswith("adds too little")
        assert node.num_waiting == 2


def test_recon_may_be_killed_and_started_again_and_so_may_the_program(tmp_path):
    with publisher(tmp_path) as node:
        for index in range(3):
            node.publish(picture(index), name=f"{index}")
        with recon(tmp_path, capacity=2) as client:
            lost = wait_for(lambda: client.receive(0.05), 10.0)  # it dies before it has acknowledged that
        assert lost.frame.name == "0" and not node.flush(0.1)
    with publisher(tmp_path) as node, recon(tmp_path) as client:  # the program, too, has been started again
        assert node.num_waiting == 3
        node.publish(picture(3), name="3")
        assert [frame.name for frame in receive(client, 4)] == ["0", "1", "2", "3"] and node.flush(10.0)


def test_a_killed_program_loses_nothing_that_was_published(tmp_path):
    program = (
        "import os, sys, numpy as np, splatnode\n"
        "places = {'network': {'directory': sys.argv[1] + '/run'}, 'spool': {'directory': sys.argv[1] + '/state'}}\n"
        "node = splatnode.Publisher(every_frame=True, changes=places)\n"
        "draw = np.random.default_rng(0).integers\n"
        "images = [np.kron(draw(0, 256, (12, 16, 3)), np.ones((20, 20, 1))).astype(np.uint8) for _ in range(3)]\n"
        "assert all(node.publish(image, name=str(index)).taken for index, image in enumerate(images))\n"
        "os.kill(os.getpid(), 9)\n"
    )
    assert subprocess.run([sys.executable, "-c", program, str(tmp_path)], cwd=ROOT).returncode == -9
    with publisher(tmp_path), recon(tmp_path) as client:
        assert [frame.name for frame in receive(client, 3)] == ["0", "1", "2"]


def test_a_full_spool_pushes_back_and_takes_images_again_once_there_is_room(tmp_path):
    few = changes(tmp_path) | {"spool": {"directory": tmp_path / "state", "max_frames": 2}}
    with publisher(tmp_path, changes=few) as node:
        for index in range(2):
            node.publish(picture(index))
        with pytest.raises(BufferError, match=r"was not taken: 2 keyframes .* is splatnode recon running\?"):
            node.publish(picture(2), wait_s=0.05)
        with recon(tmp_path) as client:
            client.acknowledge(wait_for(lambda: client.receive(0.05), 10.0))
            assert node.publish(picture(2), wait_s=10.0).taken  # the very image that was not taken


def test_what_recon_refuses_is_told_with_its_reason(tmp_path):
    with publisher(tmp_path) as node, recon(tmp_path) as client:
        node.publish(picture(), name="bad")
        client.refuse(wait_for(lambda: client.receive(0.05), 10.0).key, "it cannot be stored")
        assert node.flush(10.0) and node.num_acknowledged == 0
        assert node.refusals == (splatnode.RefusedImage("bad", "refused by recon: it cannot be stored"),)


def test_one_program_or_camera_publishes_at_a_time(tmp_path):
    with publisher(tmp_path) as node:
        node.publish(picture())
        with pytest.raises(BlockingIOError, match="gives this node images already"):
            publisher(tmp_path)
        with publisher(tmp_path, camera_id="right") as beside:  # another camera
            assert beside.publish(picture(1)).taken and (node.num_waiting, beside.num_waiting) == (1, 1)
    with publisher(tmp_path) as node:
        assert node.num_waiting == 1
    with pytest.raises(RuntimeError, match="closed: begin another one"):
        node.publish(picture())


@pytest.mark.parametrize(
    ("arguments", "error", "told"),
    [
        ({"image": np.zeros((4, 4, 3), np.float32)}, TypeError, r"uint8 RGB, .*got float32 \(4, 4, 3\)"),
        ({"image": np.zeros((3, 8, 9), np.uint8)}, ValueError, r"\(H, W, 3\) RGB .*got \(3, 8, 9\)"),
        ({"image": "a.jpg"}, TypeError, "bytes of a JPEG or PNG file; got str"),
        ({"image": b"no image"}, ValueError, "bytes of a JPEG or PNG file that can be read"),
        ({"captured_at": -1.0}, ValueError, "seconds since 1970"),
        ({"camera_id": "a\n"}, ValueError, r"camera_id must be up to 32 letters, digits, - and _, got 'a\\n'"),
        ({"camera_id": "x y"}, ValueError, "camera_id must be up to 32 letters, digits, - and _, got 'x y'"),
        ({"camera_id": "../x"}, ValueError, "camera_id must be up to 32 letters, digits, - and _, got '../x'"),
        ({"camera_id": 33 * "a"}, ValueError, "camera_id must be up to 32 letters"),
        ({"camera_id": 3}, TypeError, "camera_id must be a text, got int"),
        ({"pose": np.zeros((4, 4))}, ValueError, "a rigid motion"),
        ({"pose": np.eye(3)}, ValueError, r"\(4, 4\), got \(3, 3\)"),
        ({"pose_sigma": (1, 2)}, ValueError, "give pose, too"),
        ({"motion": np.eye(4)}, ValueError, "the first one of a camera has none"),
        ({"motion_sigma": (1, 2)}, ValueError, "give motion, too"),
        ({"gravity": (0, 0, 0)}, ValueError, "not zero"),
        ({"gravity": (0, 1)}, TypeError, r"\(3,\)"),
        ({"mask": np.zeros((240, 320))}, ValueError, "is it inverted"),
        ({"mask": np.ones((24, 32))}, ValueError, "make the mask of that size"),
        ({"intrinsics": np.eye(4)}, TypeError, r"K \(3, 3\)"),
        ({"intrinsics": splatnode.Intrinsics(100, 100, 90, 90, 50, 50, "given")}, ValueError, "aspect ratio"),
    ],
)
def test_what_cannot_be_used_is_refused_and_costs_nothing(tmp_path, arguments, error, told):
    with publisher(tmp_path) as node:
        with pytest.raises(error, match=told):
            node.publish(**{"image": picture(), **arguments})
        assert node.num_waiting == 0 and node.publish(picture()).taken


@pytest.mark.parametrize("camera_id", ["x y", "../x", "a\n", 33 * "a", 3])
def test_an_id_is_checked_alike_for_a_publisher_and_for_an_image(tmp_path, camera_id):
    with pytest.raises((TypeError, ValueError)) as of_all:
        splatnode.Publisher(camera_id=camera_id, changes=changes(tmp_path))
    with publisher(tmp_path) as node, pytest.raises(of_all.type, match=re.escape(str(of_all.value))):
        node.publish(picture(), camera_id=camera_id)
    with pytest.raises(ValueError, match="camera_id"):
        splatnode.Publisher(changes=changes(tmp_path) | {"camera_id": camera_id})


def test_a_configuration_that_cannot_be_used_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"camera: unknown key.*allowed here: quality"):
        splatnode.Publisher(changes=changes(tmp_path) | {"camera": {"kind": "v4l2"}})
    with pytest.raises(ValueError, match="camera_id"):
        splatnode.Publisher(camera_id="a/b", changes=changes(tmp_path))
    config = tmp_path / "publisher.yaml"
    config.write_text("selection: {coverage: 2}\n")
    with pytest.raises(ValueError, match=r"selection\.coverage"):
        splatnode.Publisher(config, changes=changes(tmp_path))


def test_it_needs_no_torch():
    program = "import sys; sys.modules['torch'] = None; import splatnode; print(splatnode.Publisher.__name__)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "Publisher\n", done.stderr
