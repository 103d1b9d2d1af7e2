"""What every prior in recon/priors keeps to, found by itself: adding a prior is one file."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from splatnode.capture.process.config import ConfigError, parse_config
from splatnode.recon.config import PriorChoice, ReconstructionConfig, apply_changes, preset
from splatnode.recon.registration import registration as registration_registration
from tests.support.synthetic import SMALL, photographs, view_graph


def loaded(kind: str):
    """The prior, or a skip where it says in its own words that weights or a package are missing."""
    module = PriorChoice(kind, None).module
    try:
        return module.load(module.Config())
    except ValueError as error:
        assert "splatnode" in str(error), "the message must name the remedy"
        pytest.skip(str(error))


def test_the_priors_are_found():
    assert set(PriorChoice.kinds()) >= {"aliked", "classical", "mast3r", "patchmatchnet", "xfeat"}
    assert "stereo" not in PriorChoice.kinds() and "pointmap" not in PriorChoice.kinds()


@pytest.mark.parametrize("kind", PriorChoice.kinds())
def test_its_configuration_has_what_all_have(kind):
    config = parse_config({"prior": {"kind": kind, "seed": 3}}, ReconstructionConfig)
    assert config.prior.kind == kind and config.prior.config.seed == 3


@pytest.mark.parametrize("kind", PriorChoice.kinds())
def test_it_keeps_the_interface(kind):
    prior = loaded(kind)
    assert prior.matcher is None or callable(prior.matcher.match)
    graph = view_graph(photographs()[:3], prior.matcher)
    registration = registration_registration.register(
        graph.keyframes, graph.pairs, registration_registration.RegistrationConfig()
    )
    assert registration is not None and [camera.index for camera in registration.cameras] == [0, 1, 2]
    pointmaps = prior.pointmaps(graph, registration)
    assert [pointmap.name for pointmap in pointmaps] == [keyframe.name for keyframe in graph.keyframes]
    for pointmap, camera, keyframe in zip(pointmaps, registration.cameras, graph.keyframes, strict=True):
        assert pointmap.depth.shape == keyframe.image.shape[:2] == pointmap.confidence.shape
        assert (pointmap.T_world_camera == camera.T_world_camera).all()
        known = pointmap.depth > 0
        assert known.mean() > 0.3
        assert (
            pointmap.confidence[~known] == 0
        ).all() and 0 <= pointmap.confidence.min() <= pointmap.confidence.max() <= 1
    known = {pointmap.name: pointmap for pointmap in pointmaps[:2]}
    (further,) = prior.further_pointmaps(graph, registration, known)
    assert further.name == pointmaps[2].name and SMALL.width == graph.keyframes[2].frame.width


def test_a_further_view_finds_depth_where_those_before_it_were_not_confirmed():
    """A camera that goes on sees what those before it saw at their edges, where no other view had confirmed it."""
    prior = loaded("classical")
    graph = view_graph(photographs()[:4], None)
    registration = registration_registration.register(
        graph.keyframes, graph.pairs, registration_registration.RegistrationConfig()
    )
    assert registration is not None
    known = {}
    for pointmap in prior.pointmaps(graph, registration)[:3]:
        assert pointmap.unchecked is not None and (pointmap.unchecked > 0).mean() > 0.95
        confirmed = np.zeros(pointmap.depth.shape, bool)
        confirmed[:, : SMALL.width // 4] = True
        known[pointmap.name] = pointmap.apply_mask(confirmed)
    (further,) = prior.further_pointmaps(graph, registration, known)
    blind = {name: replace(pointmap, unchecked=None) for name, pointmap in known.items()}
    (without,) = prior.further_pointmaps(graph, registration, blind)
    assert (further.depth > 0).mean() > max(0.5, 1.3 * (without.depth > 0).mean())


def test_another_prior_starts_from_its_own_defaults():
    config = apply_changes(preset("fast"), {"prior": {"kind": "mast3r", "longer_side": 224}})
    assert config.prior.kind == "mast3r" and config.prior.config.longer_side == 224
    assert config.optimize == preset("fast").optimize
    same = apply_changes(config, {"prior": {"max_neighbours": 2}, "size": 256})
    assert (same.prior.config.longer_side, same.prior.config.max_neighbours, same.size) == (224, 2, 256)
    assert apply_changes(ReconstructionConfig(), {}) == ReconstructionConfig()
    assert msgspec.to_builtins(ReconstructionConfig())["prior"]["kind"] == "classical"


def test_an_unknown_prior_is_answered_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"prior.kind: expected one of .*classical.*mast3r.*, got 'vggt'"):
        apply_changes(ReconstructionConfig(), {"prior": {"kind": "vggt"}})
