"""trajectory.tum: the columns are those of the benchmark."""

from __future__ import annotations

import numpy as np

from splatnode.recon.result.export.formats.tum import encode_tum
from tests.support.exported import make_camera


def test_tum_trajectory_has_frame_ids_positions_and_xyzw():
    camera = make_camera(2, angle=np.pi / 2)
    line = encode_tum([camera]).decode().splitlines()[-1].split()
    assert line[:3] == ["2", "2", "-0.5"]
    assert np.allclose([float(value) for value in line[1:]], [2, -0.5, 0.25, 0, np.sqrt(0.5), 0, np.sqrt(0.5)])
