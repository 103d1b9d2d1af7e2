"""ALIKED: the network against values of another implementation, and its matches against true cameras.

The golden values were computed by kornia 0.9.0 with weights generated from their names; ours and its agree to 1e-6,
with the real weights to 4e-6.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatnode.extras.evaluate.dataset import EvaluationScene, TrueCamera, load_scene
from splatnode.extras.priors.aliked import (
    WEIGHTS,
    Aliked,
    AlikedMatcher,
    Config,
    DeformableConv,
    detect_keypoints,
    load,
    load_aliked,
    match_mutual,
    sample_maps,
)
from splatnode.recon.keyframes import Features, Keyframe
from tests.support.generated import generated, generated_images, shapes_of


def made(width: int) -> dict[str, torch.Tensor]:
    """Weights whose normalisations divide by something near 1 and whose samples are shifted by pixels."""
    weights = {}
    for name, shape in shapes_of(lambda: Aliked(width)).items():
        weights[name] = generated(name, shape) if shape else torch.tensor(0.0)
        if ".bn" in name and name.endswith(("weight", "running_var")):
            weights[name] += 1.0
        if "offset_conv" in name:
            weights[name] *= 2.0
    return weights


# Score at row 20, column 33, mean and standard deviation of all; number of keypoints, the mean of their places and of
# the squares of these; position of the best one, three elements of its descriptor.
GOLDEN = {
    16: (
        0.3883086,
        0.4507534,
        0.09537815,
        145,
        40.49763,
        2177.573,
        53.11045,
        17.07551,
        0.03796906,
        -0.05544524,
        0.07456847,
    ),
    8: (
        0.3436635,
        0.426236,
        0.0797921,
        193,
        40.34314,
        2165.32,
        51.90491,
        4.565513,
        -0.02803267,
        0.1749753,
        -0.05469902,
    ),
}


@pytest.mark.parametrize("width", GOLDEN)
def test_it_agrees_with_another_implementation(width):
    network = Aliked(width).eval()
    network.load_state_dict(made(width))
    image = generated_images(1, 96, 64)[0].sigmoid()
    with torch.inference_mode():
        _, scores = network.compute_maps(image)
        found = network(image, 1000)
    expected = GOLDEN[width]
    places = found.points - 0.5
    got = (
        *(scores[20, 33], scores.mean(), scores.std(), len(places), places.mean(), places.square().mean()),
        *(*places[0], *found.descriptors[0, [0, 20, 50]]),
    )
    np.testing.assert_allclose(np.array(got), expected, rtol=2e-5, atol=2e-6)
    np.testing.assert_allclose(found.descriptors.norm(dim=1), 1.0, rtol=1e-5)


def test_samples_between_pixels_and_outside():
    """Bilinear by hand; what lies outside counts as 0."""
    maps = torch.tensor([[[1.0, 2.0], [3.0, 4.0]]])
    at = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 0.5], [-0.5, 0.0], [3.0, 0.0]])
    torch.testing.assert_close(sample_maps(maps, at), torch.tensor([[1.0, 2.0, 2.5, 0.5, 0.0]]))


def test_a_convolution_that_is_not_shifted_is_an_ordinary_one():
    conv = DeformableConv(3, 5)
    torch.nn.init.zeros_(conv.offset_conv.weight)
    torch.nn.init.zeros_(conv.offset_conv.bias)  # pyright: ignore[reportArgumentType]
    maps = generated_images(1, 6, 7)
    torch.testing.assert_close(conv(maps), conv.regular_conv(maps), rtol=1e-5, atol=1e-5)


def test_shifts_are_rows_then_columns():
    """All nine samples one row further down and two columns to the right: the map is moved by as much."""
    conv = DeformableConv(1, 1)
    torch.nn.init.zeros_(conv.offset_conv.weight)
    conv.offset_conv.bias = torch.nn.Parameter(torch.tensor([1.0, 2.0] * 9))
    maps = generated_images(1, 12, 12)[:, :1]
    torch.testing.assert_close(conv(maps)[..., 2:8, 2:8], conv.regular_conv(maps)[..., 3:9, 4:10], rtol=1e-5, atol=1e-5)


def test_a_keypoint_lies_where_the_scores_around_it_balance():
    scores = torch.zeros(12, 16)
    scores[5, 8] = 0.9
    scores[5, 9] = 0.8  # not a maximum of its own: it draws the keypoint towards it
    scores[8, 3] = 0.5
    scores[1, 1] = 0.95  # the window around it is cut off
    scores[9, 12] = 0.1  # too faint
    found = detect_keypoints(scores, 10)
    drawn = (np.exp(8.0) - 1.0) / (np.exp(9.0) + np.exp(8.0) + 23.0)  # by its neighbour, less what is opposite to it
    np.testing.assert_allclose(found, [[8.0 + drawn, 5.0], [3.0, 8.0]], atol=1e-5)
    assert len(detect_keypoints(scores, 1)) == 1


def test_matches_are_mutual_and_the_distinct_ones_first():
    first = torch.nn.functional.normalize(torch.tensor([[1.0, 0.1, 0.0], [0.0, 1.0, 1.0], [1.0, 0.3, 0.0]]), dim=1)
    second = torch.nn.functional.normalize(torch.tensor([[0.0, 1.0, 1.1], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), dim=1)
    assert match_mutual(first, second).tolist() == [[1, 0], [0, 1]]
    assert match_mutual(first[:1], second).shape == (0, 2)


def test_checkpoints_of_others_are_named(tmp_path):
    weights = made(8)
    torch.save(weights, tmp_path / "t16.pth")
    assert load_aliked(tmp_path / "t16.pth").desc_head.agg_weights.shape == (16, 64, 64)
    missing = {name: value for name, value in weights.items() if name != "desc_head.agg_weights"}
    torch.save(missing, tmp_path / "missing.pth")
    with pytest.raises(ValueError, match=r"not the checkpoint of ALIKED T16: it lacks desc_head.agg_weights"):
        load_aliked(tmp_path / "missing.pth")
    torch.save({**weights, "dkd.grid": torch.zeros(1)}, tmp_path / "extra.pth")
    with pytest.raises(ValueError, match=r"has dkd.grid, which does not belong"):
        load_aliked(tmp_path / "extra.pth")


def test_an_image_of_odd_size_is_refused():
    with pytest.raises(ValueError, match=r"sides that 32 divides, got \(3, 40, 64\)"):
        Aliked(8).compute_maps(torch.zeros(3, 40, 64))


def epipolar_distance(points1: np.ndarray, points2: np.ndarray, camera1: TrueCamera, camera2: TrueCamera) -> np.ndarray:
    """(M,) pixels between points of the second photograph and the true epipolar lines of those of the first."""
    motion = np.linalg.inv(camera2.T_world_camera) @ camera1.T_world_camera
    essential = np.cross(np.eye(3), motion[:3, 3]).T @ motion[:3, :3]
    lines = (
        np.c_[points1, np.ones(len(points1))] @ (np.linalg.inv(camera2.K).T @ essential @ np.linalg.inv(camera1.K)).T
    )
    return np.abs((np.c_[points2, np.ones(len(points2))] * lines).sum(1)) / np.hypot(lines[:, 0], lines[:, 1])


def plain(scene: EvaluationScene, name: str) -> Keyframe:
    """A keyframe with one point of its own and no descriptor."""
    (frame,) = scene.frames([name])
    nothing = np.zeros((0, 128), np.uint8), np.zeros(0, np.int64), np.zeros(0)
    return Keyframe(frame, frame.image, Features(np.full((1, 2), 7.0), *nothing))


@pytest.mark.parametrize(
    ("weights", "folder", "pair", "share"),
    [
        ("aliked-n16.pth", "fountain_p11", ("0000.jpg", "0006.jpg"), 0.4),
        ("aliked-t16.pth", "castle_p30", ("0000.jpg", "0003.jpg"), 0.5),
    ],
)
def test_matches_of_photographs_lie_on_the_true_epipolar_lines(shared, weights, folder, pair, share):
    """Before any check of their geometry. The fountain is seen from 58 degrees apart."""
    scene = load_scene(shared / "scenes" / folder)
    matcher = AlikedMatcher(load_aliked(shared / "weights" / "aliked" / weights), longer_side=640, num_keypoints=1000)
    first, second = (matcher.add_points(plain(scene, name)) for name in pair)
    assert matcher.add_points(first) is first and (first.features.points[0] == 7.0).all()
    matches = matcher.match(first, second)
    assert len(matches) > 150 and matches.min() >= 1
    for side in (0, 1):
        assert len(np.unique(matches[:, side])) == len(matches)
    points1, points2 = first.features.points[matches[:, 0]], second.features.points[matches[:, 1]]
    right = epipolar_distance(points1, points2, *(scene.cameras[name] for name in pair)) < 2.0
    assert right.mean() > share
    assert right[: len(right) // 2].mean() > right[len(right) // 2 :].mean()  # the distinct ones come first


def test_a_shifted_photograph_gives_shifted_keypoints(shared):
    """Positions are pixel positions: what moves by 32 pixels is found 32 pixels further."""
    network = load_aliked(shared / "weights" / WEIGHTS[0])
    image = load_scene(shared / "scenes" / "fountain_p11").image("0000.jpg")
    part = torch.from_numpy(image[200:392, 300:588]).permute(2, 0, 1) / 255.0
    with torch.inference_mode():
        first, second = network(part[..., :-32], 300), network(part[..., 32:], 300)
    chosen1, chosen2 = match_mutual(first.descriptors, second.descriptors).unbind(1)
    step = first.points[chosen1] - second.points[chosen2]
    np.testing.assert_allclose(step.median(0).values, [32.0, 0.0], atol=0.1)


def test_without_weights_it_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    with pytest.raises(ValueError, match="splatnode weights fetch aliked-n16"):
        load(Config())
