from __future__ import annotations

import numpy as np
import pytest
import torch

from splatnode.recon.scene.initialization import PixelwiseConfig, pixelwise_gaussians
from tests.support.synthetic import plane_pointmap, without


def image(pointmap, value: int = 128) -> np.ndarray:
    return np.full((*pointmap.depth.shape, 3), value, np.uint8)


def test_every_pixel_of_a_single_view_becomes_a_small_round_gaussian():
    pointmap = plane_pointmap(np.eye(4))
    gaussians = pixelwise_gaussians([pointmap], [image(pointmap)], PixelwiseConfig())
    assert len(gaussians) == pointmap.depth.size
    np.testing.assert_allclose(gaussians.means.numpy(), pointmap.points.reshape(-1, 3))
    spacing = 2.0 / pointmap.K[0, 0]
    middle = len(gaussians) // 2 + 16
    assert gaussians.scales[middle].tolist() == pytest.approx([spacing] * 3, rel=1e-3)
    assert gaussians.opacities.min().item() == pytest.approx(0.1)
    torch.testing.assert_close(gaussians.rgb, torch.full((len(gaussians), 3), 128 / 255))


def test_what_a_surer_view_shows_is_not_doubled():
    sure, unsure = plane_pointmap(np.eye(4), confidence=0.9), plane_pointmap(np.eye(4), confidence=0.5, frame_id=1)
    gaussians = pixelwise_gaussians([sure, unsure], [image(sure), image(unsure)], PixelwiseConfig())
    assert len(gaussians) == sure.depth.size and (gaussians.source_frame == 0).all()


def test_unknown_pixels_get_nothing_and_a_cap_holds():
    pointmap = plane_pointmap(np.eye(4))
    hole = np.zeros(pointmap.depth.shape, bool)
    hole[:, :10] = True
    gaussians = pixelwise_gaussians([without(pointmap, hole)], [image(pointmap)], PixelwiseConfig())
    assert len(gaussians) == (~hole).sum()
    capped = pixelwise_gaussians([pointmap], [image(pointmap)], PixelwiseConfig(), max_gaussians=100)
    assert len(capped) == 100 and capped.scales.mean() > gaussians.scales.mean()
