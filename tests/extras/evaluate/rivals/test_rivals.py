"""Stock COLMAP and GLOMAP on the built-in place, whose cameras are known, and on frames that share nothing."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="stock COLMAP needs pycolmap (pip install 'splatnode[bench]')")

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.extras.evaluate.dataset import TrueCamera
from splatnode.extras.evaluate.stability import trial
from splatnode.extras.evaluate.stability.trial import score_cameras
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.result.verdict import Code

PLACE = synthetic.Config(views=3, width=320, height=240)


@pytest.mark.parametrize("method", [trial.colmap, trial.glomap])
def test_cameras_of_the_built_in_place_are_right(method):
    cameras = synthetic.scene_cameras(PLACE)
    truth = {synthetic.frame_name(i): TrueCamera(T, K, PLACE.width, PLACE.height) for i, (T, K) in enumerate(cameras)}
    snapshot = method([*synthetic.stream(PLACE), DroppedFrame("broken.jpg", "damaged")], ReconstructionConfig())
    assert snapshot.verdict.code is Code.OK and snapshot.verdict.publishable
    assert [camera.name for camera in snapshot.cameras] == list(truth)
    assert score_cameras(snapshot.cameras, [truth]).right


def test_what_shares_nothing_is_no_scene():
    rng = np.random.default_rng(0)
    noise = [Frame(i, f"{i}.png", i, rng.integers(0, 256, (120, 160, 3), dtype=np.uint8), None) for i in range(3)]
    for frames in (noise, noise[:1], []):
        snapshot = trial.colmap(frames, ReconstructionConfig())
        assert not snapshot.verdict.publishable and snapshot.cameras == ()
        assert snapshot.verdict.frames == tuple(frame.name for frame in frames)
