"""The size that a scene chooses follows from what there is to see, and not from what it may cost."""

from __future__ import annotations

import pickle

import cv2
import numpy as np
import pytest
import torch
from msgspec import structs

from splatnode.extras.evaluate.methods import continue_reconstruction, find_start
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.optimize import training
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.scene import Scene, TrainingView
from splatnode.recon.scene.initialization import initialize_gaussians
from tests.support.synthetic import photographs, plane_pointmap, repeated

SHORT = training.RefinementConfig(iterations=20, checkpoints=())
CONFIG = ReconstructionConfig(size=160, optimize=SHORT)


@pytest.fixture(scope="module")
def start() -> bytes:
    """Cameras and points of three photographs of the synthetic place."""
    return pickle.dumps(find_start(photographs()[:3], CONFIG))


def made(start: bytes, **limits: float) -> Snapshot:
    *_, final = continue_reconstruction(pickle.loads(start), structs.replace(CONFIG, **limits))
    return final


@pytest.fixture(scope="module")
def chosen(start) -> int:
    snapshot = made(start)
    assert snapshot.verdict.publishable and snapshot.budget == ()
    return len(snapshot.gaussians)


def test_more_than_it_needs_changes_nothing(start, chosen):
    for limits in ({"max_gaussians": 10 * chosen}, {"max_mb": 100.0}, {"budget_s": 1e4}):
        rich = made(start, **limits)
        assert len(rich.gaussians) == pytest.approx(chosen, rel=0.05)
        assert rich.budget == ()


def test_a_limit_below_is_used_in_full_and_told(start, chosen):
    poor = made(start, max_gaussians=chosen // 4)
    assert len(poor.gaussians) == chosen // 4
    (hit,) = poor.budget
    assert (hit["code"], hit["limit"]) == ("BUDGET_HIT", "max_gaussians")
    assert 0.5 * chosen < float(str(hit["would_take"])) < 2 * chosen


def test_the_same_photographs_again_add_nothing(chosen):
    twice = find_start(repeated(photographs()[:3], 2), CONFIG)
    assert len(made(pickle.dumps(twice)).gaussians) == pytest.approx(chosen, rel=0.05)


def leaves(radius: float, size: int = 256) -> np.ndarray:
    """Leaves of about this radius, in pixels, each of one colour."""
    random = np.random.default_rng(0)
    image = np.full((size, size, 3), 128, np.uint8)
    for _ in range(round(0.5 * (size / radius) ** 2)):
        x, y = random.integers(0, size, 2)
        cv2.circle(image, (int(x), int(y)), round(radius), random.integers(0, 255, 3).tolist(), -1, cv2.LINE_AA)
    return image


def refined_wall(image: np.ndarray) -> int:
    """How many Gaussians remain of a wall with this picture on it, seen from one place."""
    size = image.shape[0]
    pointmap = plane_pointmap(np.eye(4), width=size, height=size)
    T, K = torch.eye(4), torch.from_numpy(pointmap.K).float()
    view = TrainingView("0.png", 0, image, T, K)
    scene = Scene((view,), initialize_gaussians([pointmap], [image], CONFIG.initialization))
    return len(list(training.refine(scene, SHORT, seed=0))[-1].gaussians)


def test_twice_the_detail_takes_clearly_more_and_a_blank_wall_next_to_nothing():
    coarse, fine = refined_wall(leaves(16.0)), refined_wall(leaves(8.0))
    assert 1.5 * coarse < fine < 6 * coarse
    assert 50 * refined_wall(np.full((256, 256, 3), 128, np.uint8)) <= fine
