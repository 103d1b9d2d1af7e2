"""Whatever comes over the wire as a scene, the viewer refuses it or draws it."""

from __future__ import annotations

import threading
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from splatnode.capture.messaging.messages import Message, Numbering, WireError, decode, encode
from splatnode.capture.messaging.network import RECON_SCENE, Network
from splatnode.capture.messaging.pubsub import StateServer
from splatnode.recon.result.message import SceneHeader, decode_snapshot, encode_snapshot
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.viewer.analysis import analyse
from splatnode.viewer.session import Session
from splatnode.viewer.sources import FixedSource, LiveSource, _sanitize_snapshot
from splatnode.viewer.state import BINDINGS, Moment, ViewerState
from tests.capture.messaging.test_sockets import wait_for

COUNT = 6
RANDOM = np.random.default_rng(0)


def camera(index: int, **changes) -> CameraEstimate:
    T = np.eye(4)
    T[0, 3] = index
    return replace(CameraEstimate(f"{index}.png", index, T, np.diag([100.0, 100.0, 1.0]), 64, 48), **changes)


def scene(cameras=2, bases=1, **arrays) -> Snapshot:
    given = {
        "means": np.stack([np.linspace(-1, 1, COUNT), np.zeros(COUNT), np.full(COUNT, 2.0)], 1),
        "quats": np.tile([1.0, 0, 0, 0], (COUNT, 1)), "scales": np.full((COUNT, 3), 0.1),
        "opacities": np.full(COUNT, 0.5), "sh": np.zeros((COUNT, bases, 3)),
    }  # fmt: skip
    given |= {name: np.asarray(value, float) for name, value in arrays.items() if name != "source_frame"}
    source = np.asarray(arrays.get("source_frame", np.arange(COUNT) % 2), np.int32)
    estimates = tuple(camera(index) for index in range(cameras)) if isinstance(cameras, int) else cameras
    images = {each.name: RANDOM.integers(0, 255, (48, 64, 3), np.uint8) for each in estimates}
    gaussians = GaussianArrays(**{name: value.astype(np.float32) for name, value in given.items()}, source_frame=source)
    return Snapshot(1, Verdict(Code.OK, "", "", publishable=True), estimates, gaussians, images, (), 1, final=True)


def one(value: float, shape: tuple[int, ...], rest: float = 0.5) -> np.ndarray:
    array = np.full(shape, rest)
    array.reshape(COUNT, -1)[0] = value
    return array


EDGES = (0.0, -1.0, 1e-45, 1e9, -1e9, 3e38, float("nan"), float("inf"))
SHAPES = {"means": (COUNT, 3), "quats": (COUNT, 4), "scales": (COUNT, 3), "opacities": (COUNT,), "sh": (COUNT, 1, 3)}
LENSES = [(0.001, 0.0, 0.0), (1e9, 0.0, 0.0), (100.0, 1e9, -1e9), (1e-3, 1e9, 1e9)]
SCENES = {
    **{f"{name} {value}": scene(**{name: one(value, shape)}) for name, shape in SHAPES.items() for value in EDGES},
    **{f"all {name} {value}": scene(**{name: np.full(shape, value)})
       for name, shape in SHAPES.items() for value in EDGES},
    **{f"{bases} bases": scene(bases=bases) for bases in (1, 4, 9, 16)},
    **{f"{count} cameras": scene(count) for count in (0, 1, 2, 3)},
    "source": scene(source_frame=[-(2**31), -1, 0, 1, 5, 2**31 - 1]),
    "two of one name": scene((camera(0), camera(0, name="0.png"), camera(1))),
    "one place": scene((camera(0), camera(0, name="b"), camera(0, name="c"))),
    "far": scene((camera(0), camera(10**9))),
    "small pictures": scene((camera(0, width=1, height=1), camera(1, width=1, height=65_535))),
    **{f"lens {lens}": scene((camera(0, K=np.array([[lens[0], 0, lens[1]], [0, lens[0], lens[2]], [0, 0, 1.0]])),
                              camera(1))) for lens in LENSES},
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_that_passes_the_wire_is_drawn(name):
    header, arrays = encode_snapshot(SCENES[name], "place", Numbering().next())
    live = decode_snapshot(decode([bytes(part) for part in encode(header, arrays)], SceneHeader))
    moment = Moment(_sanitize_snapshot(live.snapshot), 0.0, "place")
    analyse(moment)
    session = Session(FixedSource(moment), ViewerState())
    try:
        assert session.receive()
        for binding in BINDINGS:
            session.press(binding.key)
            assert session.paint(64, 48).shape == (48, 64, 3)
            session.press(binding.key)
        for each in live.snapshot.cameras[:2]:
            session.state = replace(ViewerState(), camera=each.name, blend=0.5)
            assert session.paint(64, 48).shape == (48, 64, 3)
            session.click(32.0, 24.0, 64, 48)
    finally:
        session.close()


def test_scenes_that_are_refused_end_no_viewer(tmp_path):
    network, numbering = Network(directory=tmp_path / "run"), Numbering()
    with StateServer(RECON_SCENE, network) as server:
        live = LiveSource(network)
        try:
            header, arrays = encode_snapshot(scene(), "place", numbering.next())
            for change in (
                [np.zeros((COUNT, 2, 3), np.float32) if index == 4 else array for index, array in enumerate(arrays)],
                arrays[:-1],
                [*arrays[:-1], np.zeros(10, np.uint8)],
            ):
                with pytest.raises(WireError):
                    decode_snapshot(Message(header, tuple(change)))
                header = msgspec.structs.replace(header, **numbering.next())
                server.publish(header, change)
                wait_for(lambda: server.serve(0.05) or live.age_s < 60)
            good = encode_snapshot(scene(), "good", numbering.next())
            server.publish(*good)

            def shown():
                server.serve(0.02)
                moment = live.take()
                return moment and moment.scene_id == "good"

            wait_for(shown)
            assert threading.active_count() > 1
        finally:
            live.close()
