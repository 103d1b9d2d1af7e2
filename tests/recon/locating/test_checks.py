"""Each check refuses what it is for, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.recon.locating import LocalizationBounds, Reason, pose_refinement, verification
from splatnode.recon.locating.pose_refinement import PINHOLE, CameraModel, Correspondences, Lens
from splatnode.recon.locating.verification import PoseHypothesis, QueryContext

WIDTH, HEIGHT = 1024, 768
LENS = Lens(800.0, PINHOLE, np.zeros(2), 0.01, 0.0, 0.0)
CAMERA = CameraModel(np.eye(3), np.zeros(3), LENS)


def seen(camera: CameraModel, count: int, spread: float = 1.0, seed: int = 0, first: int = 0) -> Correspondences:
    """Points before the camera, over that share of its picture, seen with a tenth of a pixel of noise."""
    draw = np.random.default_rng(seed)
    pixels = spread * draw.uniform(-0.5, 0.5, (count, 2)) * [WIDTH, HEIGHT]
    depth = draw.uniform(2.0, 6.0, (count, 1))
    in_camera = np.column_stack([pixels / LENS.focal, np.ones(count)]) * depth
    points = (in_camera - camera.translation) @ camera.rotation
    along = points - camera.T_world_camera[:3, 3]
    index = first + np.arange(count)
    return Correspondences(
        pixels + draw.normal(0, 0.1, pixels.shape),
        index,
        points,
        np.zeros((count, 3, 3)),
        index,
        np.zeros(count, int),
        along / np.linalg.norm(along, axis=1, keepdims=True),
    )


def together(*parts: Correspondences) -> Correspondences:
    names = Correspondences.__dataclass_fields__
    return Correspondences(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def unrelated(count: int) -> Correspondences:
    """Pixels with landmarks that they do not show."""
    known = seen(CAMERA, count, seed=9, first=10_000)
    return replace(known, pixels=known.pixels[::-1])


def judged(known: Correspondences) -> PoseHypothesis:
    by = QueryContext(known, WIDTH, HEIGHT, 0.5, 1.0, pose_refinement.PoseSearchConfig())
    return by.make_hypothesis(by.estimate_pose(LENS))


def code(known: Correspondences) -> Reason | None:
    refusal = verification.run_checks(judged(known), verification.LocalizationCheckConfig())
    return None if refusal is None else refusal.code


@pytest.mark.parametrize("wrong", [0, 200, 600])
def test_a_good_photograph_passes_all_whatever_else_was_matched(wrong):
    known = together(seen(CAMERA, 60), unrelated(wrong))
    assert code(known) is None
    camera = judged(known).posed
    assert camera is not None and np.allclose(camera.fit.camera.T_world_camera, np.eye(4), atol=0.01)


def test_unrelated_points_are_not_enough_however_many():
    for count in (0, 3, 50, 1500):
        assert code(unrelated(count)) is Reason.NOT_FOUND


def test_many_features_of_one_spot_count_as_one():
    known = seen(CAMERA, 30)
    once = judged(together(known, unrelated(300)))
    copies = [
        replace(
            known,
            pixels=known.pixels + 0.2 * i,
            feature_of=known.feature_of + 100 * i,
            landmark_of=known.landmark_of + 100 * i,
        )
        for i in range(4)
    ]
    often = judged(together(*copies, unrelated(300)))
    assert len(often.inliers) > 3 * len(once.inliers)
    assert often.num_independent < 1.5 * once.num_independent


def test_what_agrees_in_one_spot_is_refused():
    known = together(seen(CAMERA, 60, spread=0.15), unrelated(50))
    assert code(known) is Reason.ONE_PATCH


def test_a_scene_that_repeats_itself_is_refused():
    moved = CameraModel(Rotation.from_euler("y", 8.0, degrees=True).as_matrix(), np.array([1.0, 0.0, 0.0]), LENS)
    known = together(seen(CAMERA, 60), seen(moved, 50, seed=1, first=500))
    assert code(known) is Reason.ELSEWHERE
    few = together(seen(CAMERA, 60), seen(moved, 20, seed=1, first=500))
    assert code(few) is None


def test_halves_that_say_different_things_are_refused():
    """The right half is of a wall that was moved to the side: by little, so that both agree within the tolerance."""
    known = seen(CAMERA, 3000)
    right = known.pixels[:, 0] > 0
    assert code(replace(known, pixels=known.pixels + [2.0, 2.0] * right[:, None])) is Reason.INCONSISTENT


def test_a_lens_that_no_camera_has_is_refused():
    case = judged(seen(CAMERA, 60))
    assert case.posed is not None
    for lens in (replace(LENS, focal=100.0), replace(LENS, shift=np.array([600.0, 0.0]))):
        fit = replace(case.posed.fit, camera=replace(case.posed.fit.camera, lens=lens))
        refusal = verification.run_checks(
            replace(case, posed=replace(case.posed, fit=fit)), verification.LocalizationCheckConfig()
        )
        assert refusal is not None and refusal.code is Reason.LENS


def test_what_is_known_too_roughly_is_refused():
    assert (
        verification.check_uncertainty(LocalizationBounds(1.0, 0.02, 2.0, 1.0), verification.LocalizationCheckConfig())
        is None
    )
    for claim in (
        LocalizationBounds(6.0, 0.02, 2.0, 1.0),
        LocalizationBounds(1.0, 0.2, 20.0, 1.0),
        LocalizationBounds(np.nan, np.nan, np.nan, 1.0),
    ):
        refusal = verification.check_uncertainty(claim, verification.LocalizationCheckConfig())
        assert refusal is not None and refusal.code is Reason.UNCERTAIN
