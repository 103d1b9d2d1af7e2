"""What cameras tell of their exposure goes into the light of the scene that begins with their photographs."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.capture.frame import ExposureSettings
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.modelling import create_initial_scene
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.scene import Scene
from tests.support.row_of_views import graph_of, maps_of, registration_of

TIMES = (0.01, 0.04, 0.01, 0.01)


def begun(exposures: dict[int, ExposureSettings]) -> Scene:
    """Photographs that are too small to share enough pixels."""
    graph, maps = graph_of(4, exposures), maps_of(range(4))
    verdict = Verdict(Code.OK, "", "", publishable=True)
    scene = create_initial_scene(Reconstruction(graph, registration_of(4), None, verdict, maps), ReconstructionConfig())
    assert scene is not None
    return scene


def test_a_scene_begins_in_the_light_that_cameras_tell():
    scene = begun({index: ExposureSettings(time_s, 100.0) for index, time_s in enumerate(TIMES)})
    gains = [view.exposure.gains for view in scene.views if view.exposure is not None]
    expected = (np.array(TIMES) / 0.01) ** (1.0 / 2.2)
    assert gains == pytest.approx(np.repeat(expected[:, None], 3, 1), rel=0.05)


def test_and_else_in_the_light_of_the_photographs():
    assert [view.exposure for view in begun({}).views] == [None] * 4
