"""Codes of images: photographs of one place are more alike than those of two."""

from __future__ import annotations

import numpy as np

from splatnode.recon.keyframes import Features
from splatnode.recon.matching.features import (
    FeatureConfig,
    add_affine_features,
    compute_global_descriptor,
    extract,
    similarities,
)
from tests.support.synthetic import photographs, places


def features_of(frame) -> Features:
    return extract(frame.image, FeatureConfig(max_num_features=2000))


def test_photographs_of_one_place_are_more_alike_than_those_of_two():
    here, there = photographs()[:4], places()[-3:]
    codes = [compute_global_descriptor(features_of(frame)) for frame in (*here, *there)]
    alike = similarities(codes)
    np.testing.assert_allclose(np.diag(alike), 1.0, rtol=1e-4)
    place = np.repeat([0, 1], [len(here), len(there)])
    same = (place[:, None] == place) & ~np.eye(len(place), dtype=bool)
    other = place[:, None] != place
    for row in range(len(place)):
        assert alike[row][same[row]].max() > alike[row][other[row]].max()


def test_a_code_has_unit_length_and_tilted_features_do_not_change_it():
    frame = photographs()[0]
    plain = features_of(frame)
    code = compute_global_descriptor(plain)
    assert code.shape == (64 * 128,) and np.isclose(np.linalg.norm(code), 1.0, rtol=1e-4)
    np.testing.assert_array_equal(
        compute_global_descriptor(add_affine_features(plain, frame.image, (1.6,), FeatureConfig())), code
    )


def test_an_image_without_features_is_like_no_other():
    none = Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), np.zeros(0, np.int64), np.zeros(0))
    assert not compute_global_descriptor(none).any()
    one = Features(np.zeros((1, 2)), np.full((1, 128), 15, np.uint8), np.zeros(1, np.int64), np.ones(1))
    assert np.isfinite(
        similarities([compute_global_descriptor(none), compute_global_descriptor(one), compute_global_descriptor(none)])
    ).all()
