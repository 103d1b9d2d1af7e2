import itertools

import cv2
import msgspec
import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.capture.cameras.synthetic import Config
from splatnode.capture.diorama import Shape, face_points, place, ray_interval, surface_coordinates
from splatnode.capture.frame import Clock, Intrinsics, Stamp
from splatnode.capture.lenses import unproject
from tests.support.synthetic import SMALL, photographs, planar, pure_rotation, pure_rotation_cameras, tiny_scene


@pytest.mark.parametrize("shape", Shape)
def test_rays_meet_the_surface_and_enter_before_they_leave(shape):
    rng = np.random.default_rng(0)
    origin = 4 * _unit(rng.normal(size=(500, 3)))
    direction = rng.uniform(-1, 1, (500, 3)) - origin
    near, far = ray_interval(shape, tuple(origin.T), tuple(direction.T))
    hit = near <= far
    assert 0.4 < hit.mean() <= 1.0
    on_surface, inside = (
        origin[hit] + t[hit, None] * direction[hit]
        for t in (near, np.where(hit, near, 0) / 2 + np.where(hit, far, 0) / 2)
    )
    assert np.allclose(_size(shape, on_surface), 1)
    assert (_size(shape, inside) <= 1).all()
    assert (np.min([_size(shape, origin + t * direction) for t in np.linspace(0, 3, 400)], 0)[~hit] > 1).all()


@pytest.mark.parametrize(("shape", "face"), [(shape, face) for shape in Shape for face in range(shape.num_faces)])
def test_texture_coordinates_invert_the_parametrisation(shape, face):
    u, v = np.meshgrid(np.linspace(0.1, 0.9, 5), np.linspace(0.15, 0.85, 6))
    flat_cap = shape is Shape.CYLINDER and face > 0
    keep = np.hypot(2 * u - 1, 2 * v - 1) < 0.95 if flat_cap else np.ones_like(u, bool)
    points, normals = face_points(shape, face, u[keep], v[keep])
    assert np.allclose(_size(shape, points), 1)
    assert (np.einsum("...i,...i", points, normals) > 0).all()
    found, uv = surface_coordinates(shape, points)
    assert (found == face).all()
    assert np.allclose(uv, np.stack([u[keep], v[keep]], 1))


def _size(shape: Shape, points: np.ndarray) -> np.ndarray:
    """1 on the surface of the unit shape, less inside."""
    x, y, z = np.moveaxis(points, -1, 0)
    if shape is Shape.BOX:
        return np.abs(points).max(-1)
    return np.sqrt(x * x + y * y + z * z) if shape is Shape.ELLIPSOID else np.maximum(np.hypot(x, y), np.abs(z))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_frames_are_those_of_an_unknown_camera():
    frames = photographs(SMALL)
    assert [frame.frame_id for frame in frames] == list(range(SMALL.views))
    assert len({frame.name for frame in frames}) == SMALL.views
    assert all(a.stamp_ns < b.stamp_ns for a, b in itertools.pairwise(frames))
    assert all(frame.captured_at == Stamp(frame.stamp_ns, Clock.RECORDING) for frame in frames)
    assert all(frame.image.shape == (240, 320, 3) and frame.intrinsics is None for frame in frames)


def test_cameras_are_rigid_upright_and_ten_degrees_apart():
    cameras = synthetic.scene_cameras(SMALL)
    for T_world_camera, K in cameras:
        rotation = T_world_camera[:3, :3]
        assert np.allclose(rotation.T @ rotation, np.eye(3)) and np.linalg.det(rotation) == pytest.approx(1)
        assert rotation[2, 1] < -0.9  # the camera's y axis points down in a world whose z points up
        assert (K[0, 2], K[1, 2]) == (160, 120) and K[0, 0] == K[1, 1] == cameras[0][1][0, 0]
    towards = [_unit(T[:3, 3] - synthetic.TARGET) for T, _ in cameras]
    angles = [np.degrees(np.arccos(a @ b)) for a, b in itertools.pairwise(towards)]
    assert min(angles) > 7 and max(angles) < 16


def test_held_out_cameras_lie_between_the_training_cameras():
    cameras, held_out = synthetic.scene_cameras(SMALL), synthetic.evaluation_cameras(SMALL)
    assert len(held_out) == SMALL.views - 1
    centres = np.array([T[:3, 3] for T, _ in cameras])
    for index, (T_world_camera, _) in enumerate(held_out):
        gap = np.linalg.norm(centres[index + 1] - centres[index])
        assert np.linalg.norm(T_world_camera[:3, 3] - centres[index : index + 2], axis=1).max() < 0.85 * gap


def test_depth_and_cameras_predict_where_the_next_view_sees_a_point():
    """Pixels moved by true depth and true cameras show the same colours: images, depth and cameras agree."""
    config = msgspec.structs.replace(SMALL, noise=0.0)
    (T_a, K), (T_b, _) = synthetic.scene_cameras(config)[:2]
    image_a, image_b = (synthetic.render_image(config, camera).astype(np.float32) for camera in ((T_a, K), (T_b, K)))
    depth_a, depth_b = (synthetic.depth(config, index) for index in (0, 1))
    assert np.isfinite(depth_a).all() and depth_a.min() > 1 and depth_a.max() < 6
    u, v = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    points = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T * depth_a[..., None]
    T_b_a = np.linalg.inv(T_b) @ T_a
    moved = points @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    pixels = (moved / moved[..., 2:] @ K.T)[..., :2].astype(np.float32) - 0.5
    inside = (pixels > 1).all(-1) & (pixels < (318, 238)).all(-1)
    seen_depth = cv2.remap(depth_b, pixels[..., 0], pixels[..., 1], cv2.INTER_NEAREST)
    visible = inside & (np.abs(seen_depth - moved[..., 2]) < 0.02)
    assert visible.mean() > 0.5
    warped = cv2.remap(image_b, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR)
    error = np.abs(warped - image_a).mean(-1)[visible]
    shifted = np.abs(np.roll(warped, 2, axis=1) - image_a).mean(-1)[visible]
    assert np.median(error) < 6
    assert np.median(shifted) > 1.5 * np.median(error)


def test_same_seed_same_pixels_and_another_seed_another_place():
    tiny = synthetic.Config(views=1, width=64, height=48)
    (first,), (again,) = synthetic.stream(tiny), synthetic.stream(tiny)
    assert np.array_equal(first.image, again.image)
    known = synthetic.solids(tiny)
    rebuilt = place.__wrapped__(tiny.seed, density=64.0)
    assert known is place(tiny.seed, density=64.0)
    for one, same in zip(known, rebuilt, strict=True):
        assert np.array_equal(one.axes, same.axes) and np.array_equal(one.centre, same.centre)
        assert all(np.array_equal(*skins) for skins in zip(one.skins, same.skins, strict=True))
    (other,) = synthetic.stream(msgspec.structs.replace(tiny, seed=1))
    assert np.abs(first.image.astype(int) - other.image).mean() > 15


def test_a_place_stands_the_same_at_every_size():
    small, large = (synthetic.Config(views=1, width=width, height=width * 3 // 4) for width in (64, 128))
    difference = np.abs(synthetic.depth(large, 0)[::2, ::2] - synthetic.depth(small, 0))
    assert np.median(difference) < 0.02 and (difference > 0.3).mean() < 0.05


def test_there_is_texture_to_match_but_not_everywhere():
    image = cv2.cvtColor(photographs(SMALL)[3].image, cv2.COLOR_RGB2GRAY)
    keypoints = cv2.SIFT.create().detect(image, None)
    assert len(keypoints) > 400
    counts, _, _ = np.histogram2d(
        [point.pt[0] for point in keypoints],
        [point.pt[1] for point in keypoints],
        bins=(8, 6),
        range=((0, 320), (0, 240)),
    )
    assert (counts > 0).mean() > 0.8
    assert counts.max() > 8 * max(np.median(counts), 1) or (counts < 3).any()


def test_pure_rotation_is_a_homography():
    turning = msgspec.structs.replace(SMALL, views=4)
    frames, cameras = pure_rotation(turning), pure_rotation_cameras(turning)
    (T_a, K), (T_b, _) = cameras[2:4]
    assert np.allclose(T_a[:3, 3], T_b[:3, 3])
    to_zero = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # cv2 puts the first pixel's centre at (0, 0)
    H = to_zero @ K @ T_b[:3, :3].T @ T_a[:3, :3] @ np.linalg.inv(K) @ np.linalg.inv(to_zero)
    warped = cv2.warpPerspective(frames[2].image, H, (320, 240))
    overlap = cv2.warpPerspective(np.ones((240, 320), np.uint8), H, (320, 240), flags=cv2.INTER_NEAREST) > 0
    assert np.median(np.abs(warped.astype(int) - frames[3].image)[overlap]) < 6


def test_planar_frames_show_one_wall():
    for frame in planar(SMALL):
        assert (frame.image.max(-1) > 10).mean() > 0.99


def test_tiny_scene_is_in_front_of_its_cameras():
    scene = tiny_scene()
    viewmats = scene.Ts_world_camera.inverse()
    local = scene.gaussians.means @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    assert local[..., 2].min() > 1.5
    pixels = local / local[..., 2:] @ scene.Ks.mT
    inside = (
        (pixels[..., 0] > 0) & (pixels[..., 0] < scene.width) & (pixels[..., 1] > 0) & (pixels[..., 1] < scene.height)
    )
    assert inside.float().mean() > 0.8


def test_through_a_fisheye_each_pixel_shows_what_a_pinhole_sees_along_its_ray():
    lens = Intrinsics(120, 90, 41, 41, 60, 45, "calibration", (), "fisheye")  # 168 degrees across
    config = Config(width=120, height=90, views=2, noise=0.0, lens=lens)
    frame = next(iter(synthetic.stream(config)))
    assert frame.intrinsics == lens
    straight = Config(width=256, height=192, views=2, noise=0.0, samples=1)  # of a place with as many texels
    T_world_camera = synthetic.scene_cameras(config)[0][0]
    K = np.array([[64.0, 0, 128], [0, 64, 96], [0, 0, 1]])
    seen, depth = (make(straight, (T_world_camera, K)) for make in (synthetic.render_image, synthetic.depth_map))
    pixels = np.stack(np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5), -1).reshape(-1, 2)
    rays = unproject(pixels, lens)
    at = rays[:, :2] / rays[:, 2:] * 64 + (128, 96)
    both = np.flatnonzero((rays[:, 2] > 0.3) & (at > 1).all(1) & (at < (255, 191)).all(1))
    columns, rows = at[both].astype(int).T
    assert len(both) > 3000
    assert np.corrcoef(frame.image.reshape(-1, 3)[both].ravel(), seen[rows, columns].ravel())[0, 1] > 0.9
    expected = depth[rows, columns]
    found = synthetic.depth(config, 0).ravel()[both]
    there = np.isfinite(expected) & np.isfinite(found)
    assert there.mean() > 0.4 and np.median(np.abs(found[there] / expected[there] - 1)) < 0.01
