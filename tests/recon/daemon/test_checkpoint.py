"""A reconstruction comes back from the checkpoint with its scene, and goes on growing at once."""

from __future__ import annotations

import shutil
from dataclasses import fields
from pathlib import Path
from typing import cast

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from splatnode.capture.messaging.messages import Message, ReceivedFrame
from splatnode.recon.config import PREVIEW, ReconstructionConfig
from splatnode.recon.daemon import checkpoint
from splatnode.recon.daemon import checkpoint as checkpoint_store
from splatnode.recon.daemon.checkpoint import GraphRecord, Store
from splatnode.recon.daemon.ledger import MADE_ANEW
from splatnode.recon.estimation import prepare
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.registration.registration import RegisteredCamera
from tests.support.synthetic import photographs

CONFIG = ReconstructionConfig(size=160, preview=replace(PREVIEW, iterations=1))


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> tuple[Path, IncrementalReconstruction]:
    """A checkpoint with a scene of three keyframes, and what is in it."""
    folder = tmp_path_factory.mktemp("checkpoint")
    store, made = Store(folder), IncrementalReconstruction(CONFIG)
    for sequence, frame in enumerate(photographs()[:3]):
        made.add_keyframe(prepare(store.add_frame(ReceivedFrame("0" * 32, sequence, frame)).frame, CONFIG))
    made.update()
    checkpoint.save(store, made, final=True)
    store.close()
    return folder, made


@pytest.fixture
def work(saved) -> IncrementalReconstruction:
    return saved[1]


@pytest.fixture
def store(saved, tmp_path):
    opened = Store(shutil.copytree(saved[0], tmp_path / "copy"))
    yield opened
    opened.close()


def test_cameras_of_before_lenses_had_a_second_radial_coefficient_come_back(work):
    known = work.find_reconstruction()
    record, arrays = checkpoint_store.make_reconstruction_message(known, ())
    of_one = [field.name for field in fields(RegisteredCamera) if field.name not in record.cameras[0]]
    radial = of_one.index("radial")
    cameras = [{**numbers, "radial": -0.1} for numbers in record.cameras]
    first = len(of_one) * len(cameras)
    kept = [array for index, array in enumerate(arrays[:first]) if index % len(of_one) != radial]
    message = Message(replace(record, cameras=cameras), (*kept, *arrays[first:]))
    for one, other in zip(
        checkpoint_store.parse_reconstruction(message, known.graph).registration.cameras,
        known.registration.cameras,
        strict=True,
    ):
        assert one.radial.tolist() == [-0.1, 0.0] and np.array_equal(one.T_world_camera, other.T_world_camera)


def test_what_was_estimated_and_measured_comes_back_and_is_not_made_anew(store, work, monkeypatch):
    found = checkpoint.restore(store, CONFIG)
    assert (found.keyframes, found.new, found.final) == (3, [], True)
    again = found.work

    def refuse(*_):
        raise AssertionError("estimated thoroughly again")

    monkeypatch.setattr(again, "estimate_thoroughly", refuse)
    before, after = work.find_reconstruction(), again.find_reconstruction()
    assert (
        after.verdict == before.verdict
        and after.evidence == before.evidence
        and again.publishable_names == work.publishable_names
    )
    for one, other in zip(after.registration.cameras, before.registration.cameras, strict=True):
        assert np.array_equal(one.T_world_camera, other.T_world_camera) and one.lens == other.lens
    assert after.registration.inlier_ratios == before.registration.inlier_ratios
    assert np.array_equal(after.registration.observed_pixels, before.registration.observed_pixels)
    for name, pointmap in work.state.pointmaps.items():
        known = pointmap.depth > 0
        assert np.array_equal(again.state.pointmaps[name].depth > 0, known)
        assert np.abs(again.state.pointmaps[name].depth[known] / pointmap.depth[known] - 1).max() < 1e-3
        assert np.array_equal(again.state.pointmaps[name].unchecked, pointmap.unchecked)
        assert np.abs(again.state.pointmaps[name].confidence - pointmap.confidence).max() < 0.01
        assert np.abs(again.state.pointmaps[name].normal - pointmap.normal).max() < 0.01
    further = photographs()[3]
    again.add_keyframe(prepare(further, CONFIG))
    assert again.grow() and [view.name for view in again.scene.views] == [*work.names, further.name]


def test_what_another_version_wrote_is_made_anew(store, caplog):
    store.save("graph", GraphRecord(names=["a.png"], features=[{"unknown": 1}], pairs=[], pending=[]), [])
    found = checkpoint.restore(store, CONFIG)
    assert (found.keyframes, len(found.new), found.final) == (3, 3, False) and "made anew" in caplog.text


def test_evidence_of_an_older_version_is_weighed_anew_and_no_frame_is_lost(store, work, caplog):
    """Before, the weakest link was the weakest joint, inlier ratios were agreements."""
    record, arrays = checkpoint_store.make_reconstruction_message(work.find_reconstruction(), work.publishable_names)
    older = msgspec.to_builtins(record)
    evidence = older["evidence"]
    evidence["joint"], evidence["loose"] = evidence.pop("weakest_link"), evidence.pop("disconnected")
    evidence["agreement"] = evidence.pop("inlier_ratio")
    store.save("judgement", cast(msgspec.Struct, older), arrays)
    found = checkpoint.restore(store, CONFIG)
    again = found.work
    assert "judgement of the checkpoint is made anew" in caplog.text
    assert found.keyframes == 3 and len(again.scene.views) == 3
    assert again.names + [keyframe.name for keyframe in found.new] == work.names
    assert again.estimate_soon().verdict == work.find_reconstruction().verdict


@pytest.mark.parametrize("lost", MADE_ANEW)
def test_what_is_missing_is_made_anew(store, lost):
    (store.directory / lost).write_bytes(b"damaged")
    found = checkpoint.restore(store, CONFIG)
    again = found.work
    assert found.keyframes == 3
    for keyframe in found.new:
        again.add_keyframe(keyframe)
    again.update()
    assert len(again.scene.views) == 3 and again.find_reconstruction().verdict.publishable
