"""PatchmatchNet: ours against the authors' TorchScript module, and as a prior."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatnode.extras.priors import patchmatchnet
from splatnode.extras.priors.patchmatchnet import NetworkStereo, PatchmatchNet, Source, _make_planes
from splatnode.recon.priors.stereo import StereoConfig, StereoView

HEIGHT, WIDTH, DEPTH = 64, 96, 2.0


def views(count: int = 3) -> list[StereoView]:
    """Cameras side by side before a patterned wall at depth 2: each sees it shifted by four pixels."""
    generator = torch.Generator().manual_seed(0)
    pattern = torch.rand(1, 3, HEIGHT, 2 * WIDTH, generator=generator)
    pattern = torch.nn.functional.avg_pool2d(pattern, 5, 1, 2)[0].permute(1, 2, 0)
    wall = ((pattern - pattern.min()) / (pattern.max() - pattern.min()) * 255).to(torch.uint8).numpy()
    K = np.array([[80.0, 0, WIDTH / 2], [0, 80.0, HEIGHT / 2], [0, 0, 1]])
    cameras = []
    for index in range(count):
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = 0.1 * index
        image = np.ascontiguousarray(wall[:, 4 * index : 4 * index + WIDTH])
        cameras.append(StereoView(image, K, T_world_camera, (1.0, 6.0)))
    return cameras


def test_it_computes_what_the_authors_module_computes(shared):
    folder = shared / "weights" / "patchmatchnet"
    network = patchmatchnet.load_network(folder / "patchmatchnet_dtu.pth")
    theirs = torch.jit.load(folder / "module_000007.pt", map_location="cpu").eval()
    sources = []
    for view in views():
        image = torch.from_numpy(view.image).permute(2, 0, 1).float() / 255
        T_camera_world = torch.from_numpy(np.linalg.inv(view.T_world_camera)).float()
        sources.append(Source(image, torch.from_numpy(view.K).float(), T_camera_world))
    with torch.no_grad():
        torch.manual_seed(3)
        depth, confidence, _ = theirs(
            [source.image[None] for source in sources],
            torch.stack([source.K for source in sources])[None],
            torch.stack([source.T_camera_world for source in sources])[None],
            torch.tensor([1.0]),
            torch.tensor([6.0]),
        )
        ours = network(sources[0], sources[1:], (1.0, 6.0), torch.Generator().manual_seed(3))
    torch.testing.assert_close(ours[0], depth[0, 0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(ours[1], confidence[0], rtol=1e-3, atol=1e-3)


def test_the_depth_of_a_wall(shared):
    stereo = NetworkStereo(patchmatchnet.load_network(shared / "weights" / patchmatchnet.WEIGHTS[0]))
    for depth_map in stereo.estimate_depth_maps(views(), StereoConfig(), seed=0):
        known = depth_map.depth > 0
        assert known.mean() > 0.4
        assert np.median(np.abs(depth_map.depth[known] / DEPTH - 1)) < 0.01
        np.testing.assert_allclose(np.linalg.norm(depth_map.normal[known], axis=-1), 1.0, atol=1e-4)


def test_slopes_of_a_tilted_plane_and_none_across_a_step():
    u, v = np.meshgrid(np.arange(8.0), np.arange(6.0))
    inverse_depth = (0.5 + 0.002 * u - 0.001 * v).astype(np.float32)
    inverse_depth[:, 4:] *= 2
    planes = _make_planes(inverse_depth).values
    np.testing.assert_allclose(planes[:, :4, 1], 0.002, atol=1e-6)
    np.testing.assert_allclose(planes[:, 4:, 1], 0.004, atol=1e-6)
    np.testing.assert_allclose(planes[:, :4, 2], -0.001, atol=1e-6)


def test_weights_that_are_not_its_own_are_named(tmp_path, monkeypatch):
    torch.save({"feature.conv0.conv.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(ValueError, match="not the checkpoint of PatchmatchNet"):
        patchmatchnet.load(patchmatchnet.Config(weights=tmp_path / "other.pth"))
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    with pytest.raises(ValueError, match="splatnode weights fetch patchmatchnet_dtu"):
        patchmatchnet.load(patchmatchnet.Config())


def test_the_search_is_drawn_from_the_seed():
    torch.manual_seed(0)
    network = PatchmatchNet().eval()  # untrained: only that equal seeds give equal depth is looked at
    stereo = NetworkStereo(network)
    first, again, other = (
        stereo.estimate_depth_maps(views(2), StereoConfig(), seed=seed)[0].depth for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert first.shape == other.shape
