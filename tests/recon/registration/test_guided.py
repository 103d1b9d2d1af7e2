"""Matches along epipolar lines of given poses: found where images share something, and none where they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.capture.frame import Frame, Intrinsics, make_given_pose
from splatnode.recon.keyframes import PLAIN, Features, Keyframe
from splatnode.recon.registration import known_poses
from splatnode.recon.registration.known_poses import collect_known_poses

WIDTH, HEIGHT, FOCAL = 400, 300, 350.0


def keyframes(shared: int, seed: int = 0) -> list[Keyframe]:
    """Two views of points, `shared` of which look alike in both, among as many that do not."""
    generator = np.random.default_rng(seed)
    points = generator.uniform([-1.0, -0.7, 3.0], [1.0, 0.7, 5.0], (400, 3))
    looks = generator.integers(0, 30, (400, 128), dtype=np.uint8)
    found = []
    for index, x in enumerate((-0.2, 0.2)):
        T = np.eye(4)
        T[0, 3] = x
        in_camera = points - T[:3, 3]
        pixels = FOCAL * in_camera[:, :2] / in_camera[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        own = looks.copy()
        own[shared:] = generator.integers(0, 30, (400 - shared, 128), dtype=np.uint8)
        features = Features(pixels, own, np.arange(400), np.full(400, PLAIN))
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        lens = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, "given")
        frame = Frame(index, f"{index}.png", index, image, lens)
        found.append(Keyframe(replace(frame, given_pose=make_given_pose(T, 0.001, 0.1)), image, features))
    return found


def test_features_along_the_lines_match_and_nothing_beside_them_does() -> None:
    both = keyframes(shared=150)
    given = collect_known_poses(both)
    assert given is not None
    found = known_poses.add_guided_matches(both, {}, given)[0, 1]
    right = found.matches[:, 0] == found.matches[:, 1]
    assert len(found.matches) > 130 and right.mean() > 0.9


def test_images_that_share_nothing_get_no_matches() -> None:
    both = keyframes(shared=0)
    given = collect_known_poses(both)
    assert given is not None
    assert known_poses.add_guided_matches(both, {}, given) == {}
