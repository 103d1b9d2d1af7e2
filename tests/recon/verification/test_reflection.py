"""Mirror images among frames: descriptors turned round, and frames that fit better so."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching import features
from splatnode.recon.verification import evidence
from tests.support.synthetic import photographs

FEATURES = features.FeatureConfig(max_num_features=1500)
CONFIG = evidence.ReflectionConfig()
PAIRS = set(itertools.combinations(range(5), 2))


def keyframes(mirrored: tuple[int, ...] = (), count: int = 5) -> list[Keyframe]:
    frames = [
        replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1])) if number in mirrored else frame
        for number, frame in enumerate(photographs()[:count])
    ]
    return [Keyframe(frame, frame.image, features.extract(frame.image, FEATURES)) for frame in frames]


def test_mirrored_descriptors_are_those_of_the_mirrored_image():
    (plain,), (seen,) = keyframes(count=1), keyframes((0,), count=1)
    turned = evidence.mirror_descriptors(plain.features.descriptors)
    match = features.match(turned, seen.features.descriptors, features.NearestNeighbourConfig())
    places = plain.features.points[match[:, 0]]
    places[:, 0] = plain.frame.width - places[:, 0]
    assert len(match) > 0.7 * len(turned)
    assert (np.linalg.norm(places - seen.features.points[match[:, 1]], axis=1) < 1.0).mean() > 0.95


def test_frames_that_were_mirrored_are_found():
    found = evidence.measure_reflection(keyframes((1, 4)), PAIRS, CONFIG)
    assert found.frames == tuple(photographs()[number].name for number in (1, 4))
    assert found.gain > 0.4


def test_a_further_frame_is_compared_with_known_ones():
    plain, mirrored = keyframes(), keyframes((4,))
    assert evidence.measure_further(plain[4], plain[:3], CONFIG).gain < 0.0
    found = evidence.measure_further(mirrored[4], plain[:3], CONFIG)
    assert found.frames == (photographs()[4].name,) and found.gain > CONFIG.max_further_gain


def test_the_strongest_is_one_that_is_not_a_number_where_there_is_one():
    found = [evidence.Reflection((name,), gain) for name, gain in (("a", 0.3), ("b", np.nan), ("c", 0.5))]
    assert evidence.select_strongest_reflection(found).frames == ("b",) and evidence.select_strongest_reflection(
        [found[0], found[2]]
    ).frames == ("c",)


def test_plain_frames_fit_better_as_they_are():
    assert evidence.measure_reflection(keyframes(), PAIRS, CONFIG).gain < 0.0


def test_pairs_that_are_not_compared_say_nothing():
    found = evidence.measure_reflection(keyframes((1, 4)), PAIRS - {(0, 1), (2, 4), (1, 4)}, CONFIG)
    assert found.frames and set(found.frames) <= {photographs()[number].name for number in (1, 4)}
    assert found.gain > 0.4
