"""Where Gaussians start: equations 14 to 17 worked out by hand, and pieces that can be counted and measured."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatnode.recon.priors import Pointmap
from splatnode.recon.rasterize import Camera, render_gaussians
from splatnode.recon.result.snapshot import encode_unconfirmed
from splatnode.recon.scene import Gaussians
from splatnode.recon.scene.initialization import (
    GaussianInitializationConfig,
    find_redundant_pixels,
    gaussians_from_pointmap,
    initialize_gaussians,
)
from tests.support.synthetic import plane_pointmap, without

NORMAL = (0.36, 0.48, -0.8)  # of a slanted plane


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """A camera at (x, y, z) that looks along the world's z."""
    T_world_camera = np.eye(4)
    T_world_camera[:3, 3] = x, y, z
    return T_world_camera


def wall(T_world_camera: np.ndarray, confidence: float, frame_id: int = 0) -> Pointmap:
    """4 x 3 pixels of the plane z = 2 with a focal length of 4 pixels."""
    pointmap = plane_pointmap(T_world_camera, width=4, height=3, confidence=confidence, frame_id=frame_id)
    K = np.array([[4.0, 0, 2], [0, 4.0, 1.5], [0, 0, 1]])
    return replace(pointmap, K=K, depth=np.full((3, 4), 2 - T_world_camera[2, 3], np.float32))


def plain(size: int, colour: tuple[int, int, int] = (51, 102, 204)) -> np.ndarray:
    return np.full((size, size, 3), colour, np.uint8)


def checkerboard(size: int, square: int) -> np.ndarray:
    rows, columns = np.indices((size, size)) // square
    return np.repeat((255 * ((rows + columns) % 2))[..., None], 3, 2).astype(np.uint8)


def normals(gaussians: Gaussians) -> np.ndarray:
    """(N, 3) third axes."""
    return Rotation.from_quat(gaussians.quats.double().numpy()[:, [1, 2, 3, 0]]).as_matrix()[:, :, 2]


def everything(pointmap: Pointmap) -> np.ndarray:
    return np.ones(pointmap.depth.shape, bool)


def test_a_pixel_is_redundant_where_a_more_confident_point_falls_on_it():
    # A camera 0.5 to the right sees depth 2 shifted by f b / z = 4 * 0.5 / 2 = 1 pixel to the left.
    sure, doubtful = wall(at(), 0.9), wall(at(x=0.5), 0.5, frame_id=1)
    masks = find_redundant_pixels([sure, doubtful], GaussianInitializationConfig())
    assert not masks[0].any()
    assert masks[1].tolist() == [[True, True, True, False]] * 3
    swapped = find_redundant_pixels([doubtful, sure], GaussianInitializationConfig())
    assert swapped[0].tolist() == masks[1].tolist() and not swapped[1].any()


def test_depths_must_agree_within_the_relative_tolerance():
    sure, doubtful = wall(at(), 0.9), wall(at(x=0.5), 0.5)
    doubtful.depth[0, :3] = 2.03, 2.05, 1.97  # from 2 by 1.5 %, 2.4 % and 1.5 % of itself
    for tolerance, expected in ((0.02, [True, False, True, False]), (0.01, [False] * 4)):
        assert (
            find_redundant_pixels([sure, doubtful], GaussianInitializationConfig(depth_tolerance=tolerance))[1][
                0
            ].tolist()
            == expected
        )


def test_unknown_pixels_cover_nothing_and_are_not_redundant_pixels():
    sure = without(wall(at(), 0.9), np.array([[False, True, False, False]] * 3))
    doubtful = without(wall(at(x=0.5), 0.3), np.array([[False, False, True, False]] * 3))
    assert (
        find_redundant_pixels([sure, doubtful], GaussianInitializationConfig())[1].tolist()
        == [[False, True, False, False]] * 3
    )


def test_of_equally_confident_views_the_first_keeps_its_pixels():
    masks = find_redundant_pixels([wall(at(), 0.5), wall(at(x=0.5), 0.5)], GaussianInitializationConfig())
    assert not masks[0].any() and masks[1].sum() == 9


def test_a_view_is_as_confident_as_its_pixels_are_in_the_mean():
    """Equation 14: a few sure pixels make no sure view."""
    even, uneven = wall(at(), 0.5), wall(at(x=0.5), 0.2, frame_id=1)
    uneven.confidence[:, 0] = 0.9
    masks = find_redundant_pixels([even, uneven], GaussianInitializationConfig())
    assert not masks[0].any() and masks[1].sum() == 9


def test_what_any_more_confident_view_covers_is_redundant():
    """Equations 15 to 17 go over all more confident views: each covers a column of its own."""
    views = [wall(at(), confidence, frame_id) for frame_id, confidence in enumerate((0.9, 0.7, 0.5))]
    columns = [np.arange(4)[None].repeat(3, 0) == column for column in (0, 3)]
    sure = [without(view, ~column) for view, column in zip(views[:2], columns, strict=True)]
    sure = [replace(view, confidence=np.full((3, 4), c, np.float32)) for view, c in zip(sure, (0.9, 0.7), strict=True)]
    masks = find_redundant_pixels([*sure, views[2]], GaussianInitializationConfig())
    assert masks[2].tolist() == [[True, False, False, True]] * 3
    assert not masks[0].any() and not masks[1].any()


def test_what_lies_before_the_surface_covers_what_it_hides():
    """Two points fall into one pixel: the nearer one is what the target would see."""
    two_layers = wall(at(), 0.9)
    two_layers.depth[:] = 4.0
    two_layers.depth[1, 2] = 2.0
    target = wall(at(), 0.5)
    target.depth[:] = 4.0
    expected = np.ones((3, 4), bool)
    expected[1, 2] = False
    assert find_redundant_pixels([two_layers, target], GaussianInitializationConfig())[1].tolist() == expected.tolist()


@pytest.mark.parametrize(("behind", "covers"), [(0.8, True), (1.2, False)])
def test_detail_is_not_given_up_for_a_point_seen_from_far_away(behind, covers):
    # A pixel's footprint is depth / f: at distance 2.8 it is 1.4 times that at 2, at 3.2 it is 1.6 times.
    masks = find_redundant_pixels(
        [wall(at(z=-behind), 0.9), wall(at(), 0.5)], GaussianInitializationConfig(max_footprint_ratio=1.5)
    )
    assert masks[1].any() == covers


def test_a_plain_wall_takes_one_gaussian_a_square_and_stripes_one_each():
    # A photograph of 64 pixels stands for one of 512, so that 128 pixels there are 16 here.
    pointmap = plane_pointmap(np.eye(4), width=64, height=64)
    config = GaussianInitializationConfig(max_side_px=128)
    stripes = np.tile(np.repeat([0, 255], 4), 8)[None, :, None].repeat(64, 0).repeat(3, 2).astype(np.uint8)
    assert len(gaussians_from_pointmap(pointmap, plain(64), everything(pointmap), config)) == 4 * 4
    assert len(gaussians_from_pointmap(pointmap, stripes, everything(pointmap), config)) == 4 * 16
    half = np.concatenate([plain(64)[:, :32], stripes[:, 32:]], 1)
    assert len(gaussians_from_pointmap(pointmap, half, everything(pointmap), config)) == 2 * 4 + 4 * 8


def test_a_step_in_depth_divides_pieces_as_one_in_colour_does():
    pointmap = plane_pointmap(np.eye(4), width=64, height=64)
    pointmap.depth[:, 40:] = 3.0
    gaussians = gaussians_from_pointmap(
        pointmap, plain(64), everything(pointmap), GaussianInitializationConfig(max_side_px=512)
    )
    assert len(gaussians) == 2
    assert sorted(gaussians.means[:, 2].tolist()) == pytest.approx([2.0, 3.0], rel=1e-5)


def foliage(size: int) -> np.ndarray:
    """Leaves of all sizes, each of one colour; the same picture at every size."""
    random = np.random.default_rng(0)
    image = np.zeros((512, 512, 3), np.uint8)
    for _ in range(3000):
        x, y, radius = *random.integers(0, 512, 2), random.integers(4, 16)
        cv2.circle(image, (int(x), int(y)), int(radius), random.integers(0, 255, 3).tolist(), -1, cv2.LINE_AA)
    return np.asarray(cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA), np.uint8)


def count(image: np.ndarray) -> int:
    pointmap = plane_pointmap(np.eye(4), width=image.shape[1], height=image.shape[0])
    return len(gaussians_from_pointmap(pointmap, image, everything(pointmap), GaussianInitializationConfig()))


def test_the_number_follows_from_what_there_is_to_see():
    leaves, half = foliage(512), foliage(512)
    half[:, 256:] = 128
    assert count(plain(512)) * 50 <= count(leaves)
    assert 0.4 * count(leaves) < count(half) < 0.6 * count(leaves)


def test_the_same_picture_of_twice_the_size_takes_about_as_many():
    image = foliage(512)
    assert count(foliage(1024)) == pytest.approx(count(image), rel=0.1)
    assert count(np.repeat(np.repeat(image, 2, 0), 2, 1)) == count(image)


def test_a_large_photographs_gaussians_have_its_pixels_moments():
    pointmap = plane_pointmap(np.eye(4), width=1024, height=768)
    image = np.zeros((768, 1024, 3), np.uint8)
    image[:, 513:] = 255  # within a pixel of the size at which pieces are cut
    gaussians = gaussians_from_pointmap(
        pointmap, image, everything(pointmap), GaussianInitializationConfig(max_side_px=512)
    )
    left = gaussians.subset(gaussians.rgb[:, 0] < 0.1)
    u = left.means[:, 0] / left.means[:, 2] * pointmap.K[0, 0] + pointmap.K[0, 2]
    assert float(u.min()) == pytest.approx(256.5, abs=1)
    assert 2 <= len(gaussians) <= 4


def test_every_wanted_pixel_is_covered_up_to_the_border():
    pointmap, config = (
        plane_pointmap(np.eye(4), width=137, height=91),
        GaussianInitializationConfig(footprint=1.8, opacity=0.95),
    )
    image = render(gaussians_from_pointmap(pointmap, plain(137)[:91], everything(pointmap), config), pointmap)
    assert image[2:-2, 2:-2, 2].min() > 0.5 * 204 / 255 and image[8:-8, 8:-8, 2].min() > 0.75 * 204 / 255


def test_gaussians_lie_on_a_slanted_plane_and_face_along_its_normal():
    T_world_camera = at(0.3, -0.2, 0.1)
    T_world_camera[:3, :3] = Rotation.from_euler("yx", [10, -5], degrees=True).as_matrix()
    pointmap = plane_pointmap(T_world_camera, NORMAL, (0, 0, 3), width=64, height=48, frame_id=5)
    gaussians = gaussians_from_pointmap(
        pointmap, checkerboard(64, 8)[:48], everything(pointmap), GaussianInitializationConfig()
    )
    assert len(gaussians) > 50
    np.testing.assert_allclose((gaussians.means.numpy() - (0, 0, 3)) @ NORMAL, 0, atol=1e-5)
    # Those seen at the most grazing angles are turned a little towards the camera.
    np.testing.assert_allclose(normals(gaussians), np.tile(NORMAL, (len(gaussians), 1)), atol=5e-3)
    assert set(gaussians.source_frame.tolist()) == {5}


def test_size_colour_and_opacity_of_one_piece():
    pointmap = plane_pointmap(np.eye(4), width=16, height=16)
    config = GaussianInitializationConfig(max_side_px=512, footprint=1.5, thickness=0.1, opacity=0.8)
    gaussians = gaussians_from_pointmap(pointmap, plain(16), everything(pointmap), config)
    extent = 1.5 * 16 / 12**0.5 * 2.0 / pointmap.K[0, 0]  # a square's standard deviation is its side over root 12
    torch.testing.assert_close(gaussians.scales, torch.tensor([[extent, extent, 0.1 * extent]], dtype=torch.float32))
    torch.testing.assert_close(gaussians.means, torch.tensor([[0.0, 0.0, 2.0]]), rtol=0, atol=1e-6)
    torch.testing.assert_close(gaussians.rgb, torch.tensor([[0.2, 0.4, 0.8]]))
    torch.testing.assert_close(gaussians.opacities, torch.tensor([0.8]))


def test_a_gaussian_is_as_long_and_wide_as_its_piece_and_lies_along_it():
    pointmap = plane_pointmap(np.eye(4), width=32, height=32)
    rows, columns = np.indices((32, 32))
    stripe = np.abs(rows - columns) < 3
    image = np.where(stripe[..., None], 255, 0).repeat(3, 2).astype(np.uint8)
    gaussians = gaussians_from_pointmap(pointmap, image, stripe, GaussianInitializationConfig(max_side_px=512))
    assert len(gaussians) == 1
    long, wide, _ = gaussians.scales[0].tolist()
    v, u = np.nonzero(stripe)
    expected = np.sqrt(np.linalg.eigvalsh(np.cov(u, v, bias=True) + np.eye(2) / 12))
    assert long / wide == pytest.approx(expected[1] / expected[0], rel=1e-3)
    axes = Rotation.from_quat(gaussians.quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()[0]
    assert abs(axes[:, 0] @ (0.5**0.5, 0.5**0.5, 0)) == pytest.approx(1, abs=1e-4)


def test_foreshortened_gaussians_are_longer_along_the_line_of_sight():
    pointmap = plane_pointmap(np.eye(4), (0.6, 0.0, -0.8), (0, 0, 2), width=16, height=16)
    config = GaussianInitializationConfig(max_side_px=512, max_error=1e6)
    gaussians = gaussians_from_pointmap(pointmap, plain(16), everything(pointmap), config)
    along, across, _ = gaussians.scales[0].tolist()
    assert along / across == pytest.approx(1 / 0.8, rel=0.02)
    axes = Rotation.from_quat(gaussians.quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()[0]
    assert abs(axes[:, 0] @ (0.8, 0, 0.6)) == pytest.approx(1, abs=1e-3)


def test_a_surface_seen_edge_on_is_not_stretched_out_without_end():
    pointmap = plane_pointmap(np.eye(4), width=16, height=16)
    pointmap = replace(pointmap, normal=np.tile(np.array([1.0, 0, 0], np.float32), (16, 16, 1)))
    gaussians = gaussians_from_pointmap(
        pointmap, plain(16), everything(pointmap), GaussianInitializationConfig(max_side_px=512)
    )
    assert normals(gaussians)[0, 2] == pytest.approx(-0.25, abs=0.01)
    assert 2 < float(gaussians.scales[0, 0] / gaussians.scales[0, 1]) < 5


def test_a_single_wanted_pixel_becomes_a_gaussian_at_its_point():
    pointmap = plane_pointmap(np.eye(4), NORMAL, width=32, height=32)
    wanted = np.zeros((32, 32), bool)
    wanted[20, 7] = True
    gaussians = gaussians_from_pointmap(pointmap, plain(32), wanted, GaussianInitializationConfig())
    np.testing.assert_allclose(gaussians.means.numpy(), pointmap.points[20, 7][None], rtol=1e-5)
    smallest = GaussianInitializationConfig().footprint / 12**0.5 * pointmap.depth[20, 7] / pointmap.K[0, 0]
    assert float(gaussians.scales[0, 1]) == pytest.approx(smallest, rel=0.05)


def test_nothing_wanted_gives_no_gaussians():
    pointmap = plane_pointmap(np.eye(4))
    gaussians = gaussians_from_pointmap(pointmap, plain(32)[:24], ~everything(pointmap), GaussianInitializationConfig())
    assert len(gaussians) == 0 and gaussians.quats.shape == (0, 4)


def test_without_normals_gaussians_face_the_camera():
    pointmap = plane_pointmap(np.eye(4), width=32, height=32)
    pointmap = replace(pointmap, normal=np.zeros_like(pointmap.normal))
    gaussians = gaussians_from_pointmap(pointmap, plain(32), everything(pointmap), GaussianInitializationConfig())
    directions = torch.nn.functional.normalize(gaussians.means, dim=1).numpy()
    np.testing.assert_allclose(normals(gaussians), -directions, atol=1e-5)


def test_the_gaussians_of_a_textured_plane_look_like_the_photograph():
    pointmap = plane_pointmap(np.eye(4), NORMAL, width=64, height=64)
    v, u = np.indices((64, 64)) / 63.0
    image = (255 * np.stack([u, v, 0.5 + 0.4 * np.sin(9 * u)], -1)).astype(np.uint8)
    # Opaque and wide enough to leave no gaps, as the refinement makes them.
    gaussians = gaussians_from_pointmap(
        pointmap, image, everything(pointmap), GaussianInitializationConfig(footprint=1.8, opacity=0.95)
    )
    error = render(gaussians, pointmap) - torch.from_numpy(image).float() / 255
    assert float(error[4:-4, 4:-4].abs().mean()) < 0.04


def test_what_two_views_see_starts_from_one_of_them():
    pointmaps = [plane_pointmap(np.eye(4), confidence=c, frame_id=i) for i, c in enumerate((0.5, 0.9))]
    images = [checkerboard(32, 4)[:24]] * 2
    gaussians = initialize_gaussians(pointmaps, images, GaussianInitializationConfig())
    alone = gaussians_from_pointmap(pointmaps[1], images[1], everything(pointmaps[1]), GaussianInitializationConfig())
    assert len(gaussians) == len(alone) and set(gaussians.source_frame.tolist()) == {1}


def test_doubtful_pixels_start_no_gaussian():
    pointmap = plane_pointmap(np.eye(4), width=32, height=32)
    pointmap.confidence[:, :16] = 0.04
    gaussians = initialize_gaussians(
        [pointmap], [plain(32)], GaussianInitializationConfig(min_confidence=0.05, max_side_px=256)
    )
    assert len(gaussians) == 2 and gaussians.means[:, 0].min() > 0


@pytest.mark.parametrize("most", [2000, 300, 40, 3, 0])
def test_at_most_as_many_gaussians_as_are_allowed(most):
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    pointmap = plane_pointmap(np.eye(4), width=64, height=64)
    free = initialize_gaussians([pointmap], [noise], GaussianInitializationConfig())
    assert len(free) > 2000
    bounded = initialize_gaussians([pointmap], [noise], GaussianInitializationConfig(), max_gaussians=most)
    assert len(bounded) <= most
    assert len(bounded) >= min(most // 4, len(free))  # and not many fewer


def test_large_pieces_are_not_coarsened_beyond_what_a_partition_takes():
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    pointmap = plane_pointmap(np.eye(4), width=64, height=64)
    assert (
        len(initialize_gaussians([pointmap], [noise], GaussianInitializationConfig(max_side_px=4096), max_gaussians=1))
        == 1
    )


def render(gaussians: Gaussians, pointmap: Pointmap) -> torch.Tensor:
    height, width = pointmap.depth.shape
    camera = torch.from_numpy(pointmap.T_world_camera).float(), torch.from_numpy(pointmap.K).float()
    image = render_gaussians(gaussians, Camera(*camera, width, height)).rgb
    assert image is not None
    return image


def test_a_gaussian_remembers_whether_two_views_confirm_its_depth():
    """The second camera stands beside the first: what both see is confirmed, the rest of the wall is not."""
    beside = np.eye(4)
    beside[0, 3] = 0.9
    pointmaps = [plane_pointmap(T, width=64, height=64, frame_id=i) for i, T in enumerate((np.eye(4), beside))]
    gaussians = initialize_gaussians(pointmaps, [checkerboard(64, 8)] * 2, GaussianInitializationConfig())
    sources, x = gaussians.source_frame, gaussians.means[:, 0]
    left, right = x < -0.1, x > 1.1  # of what both see, by more than a piece's width
    middle = (x > 0.1) & (x < 0.8)
    assert left.any() and (sources[left] == encode_unconfirmed(0)).all()
    assert right.any() and (sources[right] == encode_unconfirmed(1)).all()
    assert middle.any() and (sources[middle] >= 0).all()
    alone = initialize_gaussians(pointmaps[:1], [checkerboard(64, 8)], GaussianInitializationConfig())
    assert (alone.source_frame == encode_unconfirmed(0)).all()
