"""A radiance field on rays whose answer is known, and the joint optimisation on a place that is."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from splatnode.extras.evaluate.methods import FrameWithDepth
from splatnode.extras.evaluate.protocol import find_test_pose
from splatnode.extras.evaluate.regions import FieldSnapshot
from splatnode.extras.evaluate.rivals import nerfmm, nope_nerf
from splatnode.extras.evaluate.rivals.nerfmm import (
    FAR,
    NEAR,
    SAMPLES,
    Cameras,
    Field,
    FieldAppearance,
    Focal,
    RenderedRays,
    encode_frequencies,
    render_rays,
    sample_pixels,
)
from tests.support.synthetic import photographs

K = torch.tensor([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]])


class Wall(nn.Module):
    """Opaque from z = 2 on, coloured by x and y."""

    def forward(self, points, directions):
        return 1e4 * (points[:, 2] >= 2.0).float(), points.clamp(0, 1)


def test_a_wall_is_seen_where_it_stands():
    pixels = torch.tensor([[16.0, 12.0], [24.0, 20.0]])
    seen = render_rays(Wall(), torch.eye(4), K, pixels)
    step = (1 / NEAR - 1 / FAR) / SAMPLES  # of inverse depth
    assert ((1 / seen.depth - 0.5).abs() <= step).all()
    assert torch.allclose(seen.rgb[0, :2], torch.zeros(2))
    assert torch.allclose(seen.rgb[1, :2], seen.depth[1].expand(2) * 8 / 40, atol=1e-4)


def test_a_fog_of_even_density_weighs_by_its_depth():
    class Fog(nn.Module):
        def forward(self, points, directions):
            return torch.ones(len(points)), torch.ones(len(points), 3)

    seen = render_rays(Fog(), torch.eye(4), K, torch.tensor([[16.0, 12.0]]))
    assert torch.allclose(seen.rgb, torch.ones(1, 3))
    assert float(seen.depth) == pytest.approx(NEAR + 1.0, abs=0.25)  # the mean free path, as the samples resolve it


def test_encoding_by_hand():
    found = encode_frequencies(torch.tensor([[0.5]]), 2)
    quarter = 0.5**0.5
    assert torch.allclose(found, torch.tensor([[0.5, quarter, 1.0, quarter, 0.0]]), atol=1e-6)


def test_cameras_turn_about_their_axis_and_the_first_is_the_world():
    cameras = Cameras(2)
    with torch.no_grad():
        cameras.turns[1] = torch.tensor([0.0, np.pi / 2, 0.0])
        cameras.centres[1] = torch.tensor([1.0, 2.0, 3.0])
    T = cameras.T_world_camera(1)
    assert torch.allclose(T[:3, :3] @ torch.tensor([0.0, 0, 1]), torch.tensor([1.0, 0, 0]), atol=1e-6)
    assert torch.equal(T[:3, 3].detach(), torch.tensor([1.0, 2, 3]))
    assert torch.equal(cameras.T_world_camera(0), torch.eye(4))
    assert float(Focal(1.2).K(64, 48)[0, 0].detach()) == pytest.approx(1.2 * 64)


def test_gradients_of_pose_and_focal_length():
    torch.manual_seed(0)
    field = Field().double()
    pixels = torch.tensor([[3.5, 4.5], [20.5, 9.5]], dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64, requires_grad=True)
    intrinsics = K.double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda *camera: render_rays(field, *camera, pixels).rgb, (T, intrinsics), eps=1e-7, atol=1e-4
    )


def test_the_lattice_covers_an_image():
    pixels = sample_pixels(40, 30, 400)
    assert (pixels % 1 == 0.5).all() and (pixels.amax(0) < torch.tensor([40, 30])).all()
    counts = torch.histogramdd(pixels, [4, 3], range=[0.0, 40.0, 0.0, 30.0]).hist
    assert counts.min() >= 25  # of 33 on average


class Painted(nn.Module):
    """A soft wall at z = 1.5 with waves of colour."""

    def forward(self, points, directions):
        return 50 * torch.sigmoid(40 * (points[:, 2] - 1.5)), 0.5 + 0.5 * torch.sin(5 * points)


def test_a_pose_is_found_through_the_rays():
    look = FieldAppearance(Painted())
    intrinsics = K.double().numpy()
    image = look.render(np.eye(4), intrinsics, 32, 24)
    start = np.eye(4)
    start[:3, 3] = [0.08, -0.05, 0.0]
    before = float(look.difference(image, torch.from_numpy(start).float(), K))
    aligned = find_test_pose(look, image, start, intrinsics, steps=60)
    assert aligned.loss < 0.2 * before
    assert look.depth(np.eye(4)) == pytest.approx(1.5, rel=0.1)


def test_only_pixels_that_are_used_are_compared():
    look = FieldAppearance(Painted())
    image, T = look.render(np.eye(4), K.double().numpy(), 32, 24), torch.eye(4)
    used = torch.zeros(24, 32, dtype=torch.bool)
    used[3:5, 7:9] = True
    image[~used] = 0.0
    assert float(look.difference(image, T, K)) > 0.1 and float(look.difference(image, T, K, used)) < 1e-5


def test_colours_that_are_not_used_do_not_count():
    images = [torch.full((12, 16, 3), 0.25)] * 2
    spoilt = [image.clone() for image in images]
    for image in spoilt:
        image[:, 8:] = 1.0
    used = (torch.arange(16) < 8).expand(12, 16)
    config = nerfmm.FitConfig(iterations=60, checkpoints=(), rays=64)
    looks = []
    for masks in ([used, used], [None, None]):
        (learnt,) = nerfmm.fit_field(spoilt, masks, Focal(1.0), config, seed=0)
        looks.append(
            FieldAppearance(learnt.field).render(np.eye(4), np.array([[16.0, 0, 8], [0, 16, 6], [0, 0, 1]]), 16, 12)
        )
    assert float(looks[0][:, 10:].mean()) < 0.5 < float(looks[1][:, 10:].mean())


def test_both_rivals_with_rays_pass_masks_on(monkeypatch):
    frames = list(photographs()[:3])
    half = np.tile(np.arange(frames[0].width) < frames[0].width // 2, (frames[0].height, 1))
    frames[1], given = replace(frames[1], mask=half), []
    monkeypatch.setattr(nerfmm, "fit_field", lambda images, used, *rest, **named: given.extend(used) or iter(()))
    with pytest.raises(AssertionError):  # without an end there is no last snapshot
        list(nerfmm.reconstruct(frames, 0))
    assert [used is None for used in given] == [True, False, True] and 0.4 < given[1].float().mean() < 0.6
    depth = np.ones(half.shape, np.float32)
    view = nope_nerf._make_view_with_depth(FrameWithDepth("a", 0, frames[1].image, depth, np.eye(3), half))
    assert view.used is not None and view.used.shape == view.depth.shape and 0.4 < view.used.float().mean() < 0.6


def test_nerfmm_learns_a_place_and_its_cameras():
    config = nerfmm.FitConfig(iterations=80, checkpoints=(10,), rays=128)
    snapshots = list(nerfmm.reconstruct(list(photographs()[:3]), 0, config))
    assert [snapshot.iterations for snapshot in snapshots] == [10, 80, 80]
    assert [snapshot.final for snapshot in snapshots] == [False, False, True]
    last = pickle.loads(pickle.dumps(snapshots[-1]))
    assert isinstance(last, FieldSnapshot) and last.appearance.num_gaussians is None
    assert len(last.cameras) == 3 and np.linalg.norm(last.cameras[1].T_world_camera[:3, 3]) > 1e-3
    first = snapshots[0]
    assert isinstance(first, FieldSnapshot)
    image = torch.from_numpy(photographs()[0].image).float() / 255
    camera = last.cameras[0]
    T, intrinsics = torch.eye(4), torch.from_numpy(camera.K).float()
    losses = [float(each.appearance.difference(image, T, intrinsics)) for each in (first, last)]
    assert losses[1] < losses[0] < 0.3


def test_two_photographs_are_refused():
    (only,) = nerfmm.reconstruct(list(photographs()[:2]), 0)
    assert only.final and not only.verdict.publishable


def test_chamfer_by_hand():
    a, b = torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.tensor([[0.0, 0, 3]])
    assert float(nope_nerf.compute_chamfer_distance(a, b)) == pytest.approx((3 + 10**0.5) / 2 + 3)
    assert float(nope_nerf.compute_chamfer_distance(a, a.flip(0))) == pytest.approx(0, abs=1e-6)


def wall(shift: float) -> nope_nerf.ViewWithDepth:
    """A wall at depth 1, whose colours run across, from a camera that stands `shift` to the right."""
    u = torch.arange(32) + 0.5
    across = ((u - 16) / 40 + shift).expand(24, 32)
    return nope_nerf.ViewWithDepth(torch.stack([across * 0.5 + 0.5] * 3, -1), torch.ones(24, 32))


def test_the_next_view_shows_the_same_colours_from_where_it_stands():
    terms = nope_nerf.ExtraLosses([wall(0.0), wall(0.1)], Focal(40 / 32))
    at = torch.tensor([0.0, 0.05, 0.1], requires_grad=True)
    losses = [terms.compute_surface_loss(0, terms.compute_cloud(0) - torch.stack([x, *torch.zeros(2)])) for x in at]
    assert float(losses[0].detach()) == pytest.approx(0.05, rel=0.05)  # half of the shift
    assert float(losses[2].detach()) < 0.003
    losses[1].backward()
    assert at.grad[1] == pytest.approx(-0.5, rel=0.1)


def test_the_field_s_depth_pulls_at_the_scale_of_the_map():
    terms = nope_nerf.ExtraLosses([wall(0.0), wall(0.1)], Focal(40 / 32))
    seen = RenderedRays(torch.zeros(1, 3), torch.tensor([3.0]))
    late = nerfmm.FitStep(1, torch.tensor([[16.5, 12.5]]), seen, Cameras(2), progress=0.9)
    loss = terms(late)
    assert float(loss.detach()) == pytest.approx(0.04 * 2.0)
    loss.backward()
    assert terms.scales.grad.tolist() == pytest.approx([-0.04])


def test_nope_nerf_learns_a_place_from_its_depths():
    config = nerfmm.FitConfig(iterations=20, checkpoints=(), rays=64)
    frames = list(photographs()[:3])
    once, final = nope_nerf.reconstruct(frames, 0, config)
    assert not once.final and final.final and final.verdict.publishable
    assert [camera.name for camera in final.cameras] == [frame.name for frame in frames]
    assert final.seconds["points"] > 0 and final.served_by == {"depth": "multi-view depth"}
