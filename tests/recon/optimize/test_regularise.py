"""The losses of equation 13 together: what is rendered, when, and that a right scene costs nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from msgspec import structs

from splatnode.extras.evaluate.methods import CONFIGS
from splatnode.recon.config import apply_changes, preset
from splatnode.recon.networks.vit import Crop
from splatnode.recon.optimize import losses
from splatnode.recon.optimize.regularizers import PseudoView, Regularizer, RegularizerConfig
from splatnode.recon.priors import Pointmap
from splatnode.recon.rasterize.reference import Render

PAPER = CONFIGS["paper"].optimize.regularizers
WIDTH, HEIGHT = 96, 64
K = np.array([[90.0, 0.0, 48.0], [0.0, 90.0, 32.0], [0.0, 0.0, 1.0]])


def wall(x: float, frame_id: int) -> tuple[Pointmap, np.ndarray]:
    """A camera at `x` that looks at a tilted, checkered wall; depth 4 + 0.5 X in the world."""
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = x
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    ray = (u - K[0, 2]) / K[0, 0]
    depth = (4.0 + 0.5 * x) / (1.0 - 0.5 * ray)
    world_x, world_y = x + ray * depth, (v - K[1, 2]) / K[1, 1] * depth
    normal = np.broadcast_to(np.array([0.5, 0.0, -1.0]) / np.sqrt(1.25), (HEIGHT, WIDTH, 3)).astype(np.float32)
    shade = (np.floor(world_x * 2) + np.floor(world_y * 2)) % 2
    image = np.repeat((60 + 130 * shade)[..., None], 3, axis=2).astype(np.uint8)
    confidence = np.ones((HEIGHT, WIDTH), np.float32)
    pointmap = Pointmap(f"{frame_id}", frame_id, depth.astype(np.float32), confidence, normal, T_world_camera, K)
    return pointmap, image


def truth(x: float) -> Render:
    """What a right scene renders."""
    pointmap, image = wall(x, 0)
    return Render(
        torch.from_numpy(image).float() / 255.0,
        torch.from_numpy(pointmap.depth),
        torch.from_numpy(pointmap.normal),
        None,
    )


def truth_at(view: PseudoView, shift: float = 0.0) -> Render:
    """What a right scene renders from a pseudo view; a wrong one is shifted."""
    assert (view.width, view.height) == (WIDTH, HEIGHT)
    return truth(view.T_world_camera[0, 3] + shift)


def mirrored(render: Render) -> Render:
    """A scene that is wrong in colour, depth and normals."""
    assert render.rgb is not None and render.depth is not None and render.normal is not None
    normal = render.normal.flip(1) * torch.tensor([-1.0, 1.0, 1.0])
    return Render(render.rgb.flip(1), render.depth.flip(1), normal, None)


@pytest.fixture
def without_networks(monkeypatch, tmp_path):
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))


def weighted(**weights: float) -> RegularizerConfig:
    """A loss of each name with that weight, with all patches of the depth."""
    chosen = {name: {"weight": weight} for name, weight in weights.items()}
    if "depth" in chosen:
        chosen["depth"]["share"] = 1.0
    return apply_changes(preset("balanced"), {"optimize": {"regularizers": {"losses": chosen}}}).optimize.regularizers


def regularisation(config: RegularizerConfig) -> Regularizer:
    pointmaps, images = zip(*(wall(x, i) for i, x in enumerate((0.0, 0.4, 0.8))), strict=True)
    return Regularizer(pointmaps, images, config, seed=0)


def test_the_papers_schedule(without_networks):
    regularised = regularisation(PAPER)
    assert regularised.channels(0.05) == ("rgb",)
    assert regularised.channels(0.15) == ("rgb",)
    assert regularised.channels(0.2) == ("rgb", "depth", "normal") == regularised.channels(0.69)
    assert regularised.channels(0.7) == ("rgb",)
    assert regularised.pseudo_loss(lambda view, _: truth_at(view), 0.05) is None
    assert regularised.pseudo_loss(lambda view, _: truth_at(view), 0.1) is not None
    assert regularised.pseudo_loss(lambda view, _: truth_at(view), 0.8) is None
    assert regularised.training_loss(0, truth(0.0), 0.1) is None


def test_training_views_that_agree_with_their_point_maps_cost_nothing(without_networks):
    regularised = regularisation(weighted(depth=1.0, normal=1.0))
    right = regularised.training_loss(0, truth(0.0), 0.5)
    assert right is not None and right.item() == pytest.approx(0.0, abs=1e-4)
    against = regularised.training_loss(0, mirrored(truth(0.0)), 0.5)
    assert against is not None and against.item() > 1.0


def test_a_right_scene_costs_less_from_a_pseudo_view_than_a_shifted_one(without_networks):
    def loss(shift: float) -> float:
        config = structs.replace(weighted(point_render=1.0, depth=1.0, normal=1.0), off_path=0.0)
        regularised = regularisation(config)
        return sum(float(regularised.pseudo_loss(lambda view, _: truth_at(view, shift), 0.5)) for _ in range(6))

    assert loss(0.0) < 0.6 * loss(0.15)


def test_the_total_is_the_weighted_sum_of_its_losses(without_networks):
    """Equation 13, on training and pseudo views."""

    def loss(**weights: float) -> float:
        regularised = regularisation(weighted(**weights))
        pseudo = regularised.pseudo_loss(lambda view, _: mirrored(truth_at(view)), 0.5)
        training = regularised.training_loss(0, mirrored(truth(0.0)), 0.5)
        return sum(part.item() for part in (pseudo, training) if part is not None)

    alone = [loss(point_render=1.0), loss(depth=1.0), loss(normal=1.0)]
    total = 0.25 * alone[0] + 0.05 * alone[1] + 0.01 * alone[2]
    assert min(alone) > 1e-4 and loss(point_render=0.25, depth=0.05, normal=0.01) == pytest.approx(total, rel=1e-4)


@pytest.mark.parametrize("name", ["point_render", "depth", "normal"])
def test_each_loss_is_compared_with_what_the_pseudo_view_itself_shows(name, without_networks):
    """What is right from there costs little, and what is wrong much."""

    def loss(draw) -> float:
        found = regularisation(structs.replace(weighted(**{name: 1.0}), off_path=0.0))
        parts = [found.pseudo_loss(lambda view, _: draw(view), 0.5) for _ in range(6)]
        assert all(part is not None for part in parts)
        return sum(part.item() for part in parts)

    assert loss(truth_at) < 0.5 * loss(lambda view: mirrored(truth_at(view)))


def test_pixels_without_a_point_are_white_or_left_out_as_is_chosen(without_networks):
    """Where no point falls, a render costs what it differs from white by, or nothing."""
    pointmap, image = wall(0.0, 0)
    half = replace(pointmap, confidence=np.where(np.arange(WIDTH) < 40, 1.0, 0.0)[None].repeat(HEIGHT, 0))
    nothing = replace(wall(0.8, 1)[0], confidence=np.zeros_like(pointmap.confidence))
    costs = {}
    for compare in (True, False):
        chosen = {"point_render": {"weight": 1.0, "compare_unseen": compare}}
        config = apply_changes(
            preset("balanced"), {"optimize": {"regularizers": {"losses": chosen}}}
        ).optimize.regularizers
        regularised = Regularizer([half, nothing], [image, image], structs.replace(config, off_path=0.0), seed=0)

        def draw(view, _, dark: bool) -> Render:
            rgb = truth_at(view).rgb.clone()
            rgb[:, 60:] = (torch.arange(WIDTH - 60) % 2)[:, None] * (0.0 if dark else 1.0)
            return Render(rgb, None, None, None)

        dark, striped = (
            float(regularised.pseudo_loss(lambda view, _, d=d: draw(view, _, d), 0.5)) for d in (True, False)
        )
        costs[compare] = abs(dark - striped)
    assert costs[False] == pytest.approx(0.0, abs=1e-6) and costs[True] > 0.01


def test_half_size_renders_are_compared_with_half_of_what_is_known(without_networks):
    regularised = regularisation(weighted(depth=1.0, normal=1.0))
    full = truth(0.0)
    assert full.depth is not None and full.normal is not None
    half = Render(None, full.depth[::2, ::2], full.normal[::2, ::2], None)
    loss = regularised.training_loss(0, half, 0.5)
    assert loss is not None and loss.item() == pytest.approx(0.0, abs=5e-3)


def test_which_network_served_is_told(without_networks):
    assert regularisation(PAPER).served_by == {
        "point_render": "multi-scale gradient",
        "depth": "multi-view depth",
        "normal": "normals of the multi-view depth",
        "semantic": "nothing: no weights",
    }
    assert regularisation(RegularizerConfig()).served_by == {}
    nothing = regularisation(weighted(semantic=1.0))
    assert nothing.pseudo_loss(lambda view, _: truth_at(view), 0.5) is None  # no view is rendered for it


def test_losses_of_weight_zero_ask_for_nothing(without_networks):
    regularised = regularisation(weighted(depth=0.0, point_render=0.0))
    assert regularised.served_by == {} and regularised.channels(0.5) == ("rgb",)
    assert regularised.training_loss(0, truth(0.0), 0.5) is None
    assert regularised.pseudo_loss(lambda view, channels: truth(0.0), 0.5) is None


def test_networks_serve_where_their_weights_are(monkeypatch):
    """One that sees the true inverse depth up to scale and offset in one view, and its opposite in the other."""

    class Seer:
        name = "a network"

        def __call__(self, image):
            at_zero = np.array_equal(image, wall(0.0, 0)[1])
            inverse = 30.0 / wall(0.0 if at_zero else 0.4, 0)[0].depth + 5.0
            return inverse if at_zero else 40.0 - inverse, Crop(1.0, 0, 0, WIDTH, HEIGHT)

    class Encoder:
        name = "an encoder"

        def __call__(self, image):
            return torch.nn.functional.normalize(image.mean((0, 1)), dim=0)

    monkeypatch.setattr("splatnode.recon.optimize.regularizers.load_relative", Seer)
    monkeypatch.setattr("splatnode.recon.optimize.losses.semantic.load_dino", Encoder)
    pointmaps, images = zip(*(wall(x, i) for i, x in enumerate((0.0, 0.4))), strict=True)
    for pointmap in pointmaps:
        pointmap.depth[:, ::3] = 0  # several views know only a part
    served = Regularizer(pointmaps, images, PAPER, seed=0)
    depth = "depth of a network (in 1 of 2 views, scaled by multi-view depth)"
    assert served.served_by["depth"] == depth and served.served_by["normal"] == f"normals of the {depth}"
    assert served.served_by["semantic"] == "an encoder"
    right, progress = truth(0.0), 0.3
    wrong = Render(right.rgb, right.depth.flip(1), right.normal, None)
    losses = [float(served.training_loss(0, render, progress)) for render in (right, wrong)]
    assert losses[0] < 1e-3 < losses[1]
    assert Regularizer(pointmaps, images, RegularizerConfig(), seed=0).served_by == {}
    left = np.arange(WIDTH)[None].repeat(HEIGHT, 0) < WIDTH // 2  # what a mask hides, a network sees, too
    hidden = Regularizer(pointmaps, images, PAPER, seed=0, shown=[left, left])
    half = Render(right.rgb, torch.where(torch.from_numpy(left), right.depth, wrong.depth), right.normal, None)
    assert float(hidden.training_loss(0, half, progress)) < 1e-3 < float(served.training_loss(0, half, progress))


BRIGHTNESS = """
from splatnode.recon.optimize.losses import Loss, Schedule

class Config(Schedule, frozen=True, forbid_unknown_fields=True):
    wanted: float = 1.0

def prepare(config, supervision, seed):
    darkness = lambda index, render: config.wanted - render.rgb.mean()
    return Loss(f"brightness of {len(supervision.images)} photographs", on_training_view=darkness)
"""


def test_a_new_loss_is_one_new_file(tmp_path, monkeypatch):
    (tmp_path / "brightness.py").write_text(BRIGHTNESS)
    monkeypatch.setattr(losses, "__path__", [*losses.__path__, str(tmp_path)])
    config = weighted(brightness=2.0)
    regularised = regularisation(config)
    assert regularised.served_by == {"brightness": "brightness of 3 photographs"}
    loss = regularised.training_loss(0, truth(0.0), 0.5)
    assert loss is not None and loss.item() == pytest.approx(2 * (1 - truth(0.0).rgb.mean().item()))
    assert regularised.pseudo_loss(lambda view, _: truth_at(view), 0.5) is None  # no view is rendered for it


def test_a_loss_that_is_not_there_is_named_with_those_that_are():
    with pytest.raises(ValueError, match=r"losses\.depht\.kind: expected one of depth, normal, point_render, semantic"):
        weighted(depht=1.0)


def test_a_loss_may_be_used_twice_under_names_of_its_own():
    chosen = {"fine": {"kind": "depth", "weight": 1.0, "patch": 16}, "coarse": {"kind": "depth", "weight": 0.5}}
    changed = apply_changes(preset("balanced"), {"optimize": {"regularizers": {"losses": chosen}}})
    assert list(regularisation(changed.optimize.regularizers).served_by) == ["fine", "coarse"]
