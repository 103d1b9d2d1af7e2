"""Rigs in the bundle adjustment: against SciPy, and what they tell of cameras that moved or are given wrongly."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Clock as StampClock
from splatnode.capture.frame import Frame, Stamp
from splatnode.capture.rig import TOLERANCE_S, Rig, RigCamera, form_mounted_rig
from splatnode.recon.geometry import align_cameras
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.registration import bundle_adjustment, rigs
from splatnode.recon.registration.bundle_adjustment import RigConstraint
from splatnode.recon.registration.incremental_mapper import MapperResult
from splatnode.recon.registration.rigs import Mount, RigEstimate, adjust_with_rig
from tests.recon.registration.test_bundle import problem

NOISE_PX, SIGMAS = 0.5, np.array([np.radians(0.2), 0.01])
TOLD = bundle_adjustment.LensPrior(np.log([900.0]), np.zeros(1), np.zeros((1, 2)), np.zeros(1))
LOSS = bundle_adjustment.BundleAdjustmentConfig(robust_px=1e3, noise_px=NOISE_PX, tolerance=1e-12, max_iterations=200)


def two_sets(seed: int = 0) -> bundle_adjustment.Problem:
    """Cameras 0 and 1 took their images together, and 2 and 3: the second mount is that of camera 1, somewhat off."""
    true = problem(15, seed, NOISE_PX)
    X = true.rotations[1] @ true.rotations[0].T
    mounts = np.stack([np.eye(3), X])
    offsets = np.stack([np.zeros(3), true.translations[1] - X @ true.translations[0]])
    rig = RigConstraint(
        np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.tile(SIGMAS, (4, 1)),
        true.rotations[[0, 2]], true.translations[[0, 2]], mounts, offsets, np.array([True, False]),
        np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.full((2, 2), np.inf),
    )  # fmt: skip
    return replace(true, rig=rig)


def test_the_adjustment_on_a_rig_is_that_of_scipy() -> None:
    begun = two_sets()
    found = bundle_adjustment.adjust(begun, TOLD, LOSS)
    rig = begun.rig
    assert rig is not None and found.rig is not None
    count = len(begun.points)

    def at(values: np.ndarray) -> tuple[bundle_adjustment.Problem, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        steps = values[: 6 * 6].reshape(6, 6)
        turns, moves = Rotation.from_rotvec(steps[:, :3]).as_matrix(), steps[:, 3:]
        rotations = np.concatenate([begun.rotations[:1], turns[:3] @ begun.rotations[1:]])
        translations = np.concatenate([begun.translations[:1], begun.translations[1:] + moves[:3]])
        now = replace(
            begun, rotations=rotations, translations=translations, points=values[36:].reshape(count, 3), rig=None
        )
        of_sets = turns[3:5] @ rig.set_rotations, rig.set_translations + moves[3:5]
        mount = turns[5] @ rig.mount_rotations[1], rig.mount_translations[1] + moves[5]
        return now, *of_sets, *mount

    def errors(values: np.ndarray) -> np.ndarray:
        now, set_rotations, set_translations, mount_rotation, mount_translation = at(values)
        parts = [((bundle_adjustment.project(now)[0] - now.pixels) / NOISE_PX).ravel()]
        for camera in range(4):
            R, t = set_rotations[camera // 2], set_translations[camera // 2]
            if camera % 2:
                R, t = mount_rotation @ R, mount_rotation @ t + mount_translation
            turn = now.rotations[camera] @ R.T
            parts.append(Rotation.from_matrix(turn).as_rotvec() / SIGMAS[0])
            parts.append((now.translations[camera] - turn @ t) / SIGMAS[1])
        return np.concatenate(parts)

    start = np.concatenate([np.zeros(36), begun.points.ravel()])
    best, set_rotations, _, mount_rotation, mount_translation = at(
        least_squares(errors, start, method="lm", xtol=1e-12).x
    )
    # A turn's deviation is linearised: these turn by degrees
    np.testing.assert_allclose(bundle_adjustment.centres(found), bundle_adjustment.centres(best), atol=2e-3)
    np.testing.assert_allclose(found.rig.mount_rotations[1], mount_rotation, atol=1e-3)
    np.testing.assert_allclose(found.rig.mount_translations[1], mount_translation, atol=3e-3)
    np.testing.assert_allclose(found.rig.set_rotations, set_rotations, atol=1e-3)


# Three cameras on a rig that drives past a cloud of points: the model as registration leaves it, image by image.

PIXEL = 0.4
IDS = ("front", "left", "right")


def true_mounts() -> dict[str, np.ndarray]:
    """T_rig_camera, metres."""
    found = {}
    for camera_id, yaw, centre in (("front", 0, (0, 0, 0)), ("left", -20, (-0.3, 0, 0)), ("right", 25, (0.25, 0.1, 0))):
        found[camera_id] = np.eye(4)
        found[camera_id][:3, :3] = Rotation.from_euler("y", yaw, degrees=True).as_matrix()
        found[camera_id][:3, 3] = centre
    return found


def make_drive(
    num_sets: int = 8,
    moved_at: int | None = None,
    moved: tuple[str, float, float] = ("left", 2.0, 0.0),  # degrees and metres
    unit: float = 2.0,  # metres that the model's unit has
    late_m: float = 0.0,  # by which a camera's image is taken elsewhere, to and fro
    arm_deg: float = 0.0,  # by which a camera is turned further from set to set
    seed: int = 0,
) -> tuple[MapperResult, list[Keyframe], np.ndarray]:
    """The model, its keyframes, and the true T_world_camera of each, metres."""
    generator = np.random.default_rng(seed)
    points = generator.uniform((-4, -1.5, 3), (4, 1.5, 7), (150, 3))
    Ts, keyframes = [], []
    for index in range(num_sets):
        T_world_rig = np.eye(4)
        T_world_rig[:3, :3] = Rotation.from_euler("y", 3.0 * np.sin(index), degrees=True).as_matrix()
        T_world_rig[:3, 3] = 0.25 * index - 0.8, 0.1 * np.sin(2 * index), 0.1 * np.cos(index)
        for camera_id, T_rig_camera in true_mounts().items():
            T = T_world_rig @ T_rig_camera
            if moved_at is not None and index >= moved_at and camera_id == moved[0]:
                T[:3, :3] = T[:3, :3] @ Rotation.from_euler("y", moved[1], degrees=True).as_matrix()
                T[0, 3] += moved[2]
            if camera_id == "right":
                T[0, 3] += late_m * generator.normal()
                turn = Rotation.from_euler("y", arm_deg * np.sin(2.0 * index), degrees=True).as_matrix()
                T[:3, :3] = T[:3, :3] @ turn
            Ts.append(T)
            stamp = Stamp(index * 500_000_000, StampClock.RECORDING)
            frame = Frame(
                len(keyframes), f"{camera_id}_{index}.png", stamp.ns, np.zeros((8, 8, 3), np.uint8), intrinsics=None,
                captured_at=stamp, camera_id=camera_id,
            )  # fmt: skip
            keyframes.append(SimpleNamespace(name=frame.name, frame=frame))
    worlds = np.stack(Ts)
    rotations = np.swapaxes(worlds[:, :3, :3], 1, 2)
    centres = worlds[:, :3, 3] / unit
    camera_of, point_of = (each.ravel() for each in np.meshgrid(np.arange(len(Ts)), np.arange(len(points))))
    start = bundle_adjustment.Problem(
        rotations, -np.einsum("cij,cj->ci", rotations, centres), np.zeros(len(Ts), np.int64), np.log([400.0]),
        np.zeros((1, 2)), np.zeros((1, 2)), points / unit, camera_of, point_of, np.zeros((len(camera_of), 2)),
    )  # fmt: skip
    pixels, depth = bundle_adjustment.project(start)
    seen = (depth > 0) & (np.abs(pixels) < (320, 240)).all(1)
    start = replace(start, pixels=pixels + PIXEL * generator.normal(size=pixels.shape))
    start = bundle_adjustment.keep_observations(start, seen)
    prior = bundle_adjustment.LensPrior(start.log_focals, np.zeros(1), np.zeros((1, 2)), np.zeros(1))
    loss = bundle_adjustment.BundleAdjustmentConfig(noise_px=PIXEL)
    estimate = bundle_adjustment.adjust(start, prior, loss)
    found = MapperResult(tuple(range(len(Ts))), estimate, prior, loss, {}, 10.0, 0.5, 1)
    return found, cast("list[Keyframe]", keyframes), worlds


def without(found: MapperResult, views: set[int]) -> MapperResult:
    """The model in which no match places these views."""
    kept = bundle_adjustment.keep_observations(found.estimate, ~np.isin(found.estimate.camera_of, list(views)))
    return replace(found, views=tuple(v for v in found.views if v not in views), estimate=kept)


def deviate(mount: Mount, true: np.ndarray, unit: float = 2.0) -> tuple[float, float]:
    """Degrees and metres by which a mount is wrong."""
    turned = mount.T_rig_camera[:3, :3].T @ true[:3, :3]
    away = unit * mount.T_rig_camera[:3, 3] - true[:3, 3]
    return float(np.degrees(Rotation.from_matrix(turned).magnitude())), float(np.linalg.norm(away))


def find_rig(
    found: MapperResult, keyframes: list[Keyframe], rig: Rig | None = None
) -> tuple[MapperResult, RigEstimate]:
    told = adjust_with_rig(found, keyframes, rig, TOLERANCE_S)
    assert told is not None
    return told


def make_rig(**turned_deg: float) -> Rig:
    """The true rig, but for cameras turned by so many degrees."""
    cameras = []
    for camera_id, T in true_mounts().items():
        T[:3, :3] = T[:3, :3] @ Rotation.from_euler("x", turned_deg.get(camera_id, 0.0), degrees=True).as_matrix()
        cameras.append(RigCamera(camera_id, tuple(T.ravel().tolist())))
    return Rig(tuple(cameras))


def test_a_rig_is_estimated_from_all_sets_within_its_bounds() -> None:
    inside = []
    for seed in range(6):
        found, keyframes, _ = make_drive(seed=seed)
        adjusted, rig = find_rig(found, keyframes)
        assert not rig.changes and rig.metres_per_unit is None
        reference = rig.mounts[0].camera_id
        # The scale is that of the cameras' centres
        true = true_mounts()
        base = np.linalg.inv(true[reference])
        unit = scale_of(adjusted, make_drive(seed=seed)[2])
        for mount in rig.mounts[1:]:
            degrees, metres = deviate(mount, base @ true[mount.camera_id], unit)
            inside += [degrees < 1.96 * np.sqrt(3) * mount.sigma_deg, metres < 1.96 * np.sqrt(3) * unit * mount.sigma]
            assert degrees < 0.1 and metres < 0.01
    assert np.mean(inside) >= 0.9


def scale_of(found: MapperResult, worlds: np.ndarray) -> float:
    """Metres a unit, by all centres."""
    return align_cameras(world_of(found.estimate), worlds).scale


def world_of(problem: bundle_adjustment.Problem) -> np.ndarray:
    Ts = np.tile(np.eye(4), (len(problem.rotations), 1, 1))
    Ts[:, :3, :3], Ts[:, :3, 3] = np.swapaxes(problem.rotations, 1, 2), bundle_adjustment.centres(problem)
    return Ts


def test_a_camera_that_no_match_places_is_placed_by_the_rig() -> None:
    found, keyframes, worlds = make_drive()
    lost = {4, 11}
    adjusted, rig = find_rig(without(found, lost), keyframes)
    assert set(rig.placed) == lost
    aligned = align_cameras(world_of(adjusted.estimate), worlds)
    centres = aligned(bundle_adjustment.centres(adjusted.estimate))
    assert np.linalg.norm(centres - worlds[:, :3, 3], axis=1).max() < 0.02


@pytest.mark.parametrize("moved", [("left", 2.0, 0.0), ("right", 0.0, 0.06)])
def test_a_camera_that_moved_is_named_and_has_a_mount_of_its_own_then(moved: tuple[str, float, float]) -> None:
    found, keyframes, worlds = make_drive(moved_at=5, moved=moved)
    adjusted, rig = find_rig(found, keyframes)
    assert [(change.camera_ids, change.first, change.count) for change in rig.changes] == [((moved[0],), 5, 3)]
    assert [mount.camera_id for mount in rig.mounts].count(moved[0]) == 2
    aligned = align_cameras(world_of(adjusted.estimate), worlds)
    assert np.linalg.norm(aligned(bundle_adjustment.centres(adjusted.estimate)) - worlds[:, :3, 3], axis=1).max() < 0.02


def test_cameras_that_are_not_triggered_together_make_the_rig_less_sure_and_name_none() -> None:
    sure = find_rig(*make_drive()[:2])[1]
    found, keyframes, _ = make_drive(late_m=0.08)
    late = find_rig(found, keyframes)[1]
    assert not late.changes
    sigmas = [{m.camera_id: m.sigma for m in rig.mounts} for rig in (sure, late)]
    assert sigmas[1]["right"] > 2.0 * sigmas[0]["right"]


@pytest.mark.parametrize("num_sets", [3, 4, 8])
def test_a_camera_on_an_arm_is_on_no_rig_and_did_not_move_on_it(num_sets: int) -> None:
    found, keyframes, _ = make_drive(num_sets, arm_deg=6.0)
    rig = find_rig(found, keyframes)[1]
    assert not rig.changes
    assert {mount.camera_id for mount in rig.mounts} == {"front", "left"}


def test_nothing_is_claimed_of_a_rig_whose_numbers_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    found, keyframes, _ = make_drive(3)
    monkeypatch.setattr(rigs, "_mount_covariances", lambda adjusted: np.full((3, 6, 6), np.nan))
    assert adjust_with_rig(found, keyframes, None, TOLERANCE_S) is None


def test_a_known_rig_tells_metres_within_their_interval() -> None:
    for seed in range(4):
        found, keyframes, worlds = make_drive(seed=seed, unit=1.7)
        adjusted, rig = find_rig(found, keyframes, make_rig())
        assert rig.metres_per_unit is not None and not rig.refuted
        off = abs(np.log(rig.metres_per_unit / scale_of(adjusted, worlds)))
        assert off < 1.96 * rig.scale_sigma < 0.05


def test_only_cameras_that_have_images_and_are_given_count_for_the_rig() -> None:
    found, keyframes, _ = make_drive()
    cameras = {each.camera_id: each for each in make_rig().cameras}
    rig = find_rig(found, keyframes, make_rig())[1]
    assert rig.num_given == 3
    rear = replace(cameras["right"], camera_id="rear")  # took no image
    rig = find_rig(found, keyframes, Rig((cameras["front"], cameras["left"], rear)))[1]
    assert rig.metres_per_unit is not None and len(rig.mounts) == 3
    assert rig.num_given == 2
    assert find_rig(found, keyframes, make_rig(left=3.0))[1].num_given == 2, "a camera that is not believed"
    assert find_rig(found, keyframes)[1].num_given == 0


def test_cameras_whose_place_on_the_base_is_told_are_a_rig() -> None:
    """As capture's configuration tells it, with each image; a camera on an arm is none of it."""
    _, keyframes, _ = make_drive()
    mounts = {camera: tuple(T.ravel().tolist()) for camera, T in true_mounts().items()}
    told = [replace(each.frame, T_base_camera=mounts[each.frame.camera_id]) for each in keyframes]
    rig = form_mounted_rig(told)
    assert rig is not None and rig.is_base and {each.camera_id for each in rig.cameras} == set(IDS)
    assert {each.sigma_m for each in rig.cameras} == {0.005}
    found = make_drive()[0]
    assert find_rig(found, keyframes, rig)[1].metres_per_unit is not None
    moves = [replace(each, T_base_camera=mounts[IDS[index % 2]]) if each.camera_id == "right" else each
             for index, each in enumerate(told)]  # fmt: skip
    rig = form_mounted_rig(moves)
    assert rig is not None and "right" not in {each.camera_id for each in rig.cameras}
    assert form_mounted_rig(each for each in told if each.camera_id == "left") is None
    assert form_mounted_rig(each.frame for each in keyframes) is None


def test_a_camera_that_is_given_wrongly_is_named_and_not_believed() -> None:
    found, keyframes, worlds = make_drive()
    adjusted, rig = find_rig(found, keyframes, make_rig(left=3.0))
    assert rig.refuted == ("left",)
    (off,) = rig.residuals
    assert off.camera_id == "left" and off.beside in ("front", "right") and off.degrees == pytest.approx(3.0, abs=0.3)
    assert off.metres < 0.02 and off.sigma_deg < 0.3 and off.sigma_m < 0.02 and not rig.is_inverse
    assert not any(mount.given for mount in rig.mounts if mount.camera_id == "left")
    assert rig.metres_per_unit == pytest.approx(scale_of(adjusted, worlds), rel=0.03)


def test_nothing_of_a_rig_is_believed_where_it_is_wrong_and_nothing_tells_in_what() -> None:
    found, keyframes, _ = make_drive()
    rig = find_rig(found, keyframes, make_rig(left=3.0, right=-4.0, front=5.0))[1]
    assert set(rig.refuted) == set(IDS)
    assert rig.metres_per_unit is None and not any(mount.given for mount in rig.mounts)
    assert len(rig.residuals) == 2 and max(each.degrees for each in rig.residuals) > 5.0 and not rig.is_inverse


def test_a_rig_whose_poses_are_inverses_is_recognized() -> None:
    """As when the poses of a file lead from the rig to its cameras."""
    found, keyframes, _ = make_drive()
    inverses = [replace(each, T_rig_camera=tuple(np.linalg.inv(each.matrix).ravel().tolist()))
                for each in make_rig().cameras if each.matrix is not None]  # fmt: skip
    rig = find_rig(found, keyframes, Rig(tuple(inverses)))[1]
    assert set(rig.refuted) == set(IDS) and rig.is_inverse
