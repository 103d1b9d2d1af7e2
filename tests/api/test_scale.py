from __future__ import annotations

import pytest

import splatnode
from splatnode.api.photographs import load_frames
from splatnode.api.reconstruct import is_stereo, metric_changes, pairs_given
from splatnode.recon.config import ReconstructionConfig, apply_changes


def test_what_is_known_of_the_size_becomes_the_configuration():
    known = [("a.jpg", "b.jpg", 0.5), splatnode.Marker(0.08, sigma_m=0.0002), (0, 2, 1)]
    metric = apply_changes(ReconstructionConfig(), {"metric": metric_changes(known, of_pictures=True)}).metric
    assert metric.baselines == (("a.jpg", "b.jpg", 0.5), ("0000.png", "0002.png", 1.0))
    assert (metric.marker_size_m, metric.marker_size_sigma_m, metric.marker_dictionary) == (0.08, 0.0002, "4X4_50")
    assert metric_changes(splatnode.Marker(0.1), False)["marker_size_m"] == 0.1
    assert metric_changes(("a.jpg", "b.jpg", 2), False) == {
        "baseline": ["a.jpg", "b.jpg", 2.0],
        "further_baselines": [],
    }


@pytest.mark.parametrize("wrong", [0.1, "100mm", ("a.jpg", "b.jpg"), [("a.jpg", 0.5)], ("a.jpg", 3, 0.5)])
def test_what_is_no_scale_is_refused(wrong):
    with pytest.raises(TypeError, match="scale must"):
        metric_changes(wrong, of_pictures=False)


def test_pairs_are_a_folder_or_one_picture_for_each(folder, arrays):
    stereo = splatnode.Stereo(folder, 0.075)
    assert metric_changes([stereo, ("a", "b", 1)], False)["stereo_baseline_m"] == 0.075 and is_stereo(stereo)
    taken = load_frames(folder, None, False, lambda _: None).frames
    assert len(pairs_given(stereo, folder, taken)) == len(taken)  # each is its own partner
    listed = load_frames(arrays, None, False, lambda _: None).frames
    pairs = pairs_given([splatnode.Stereo(arrays, 0.1)], arrays, listed)
    assert [pair.photograph for pair in pairs] == [frame.name for frame in listed]
    assert pairs_given(splatnode.Marker(0.1), arrays, listed) == ()
    two = pairs_given([splatnode.Stereo(arrays, 0.1), splatnode.Stereo(folder, 0.5, 0.001)], arrays, listed[:1])
    assert [pair.baseline and (pair.baseline.metres, pair.baseline.sigma_m) for pair in two] == [
        (0.1, 0.0003),
        (0.5, 0.001),
    ]
    with pytest.raises(ValueError, match="markers of one size and dictionary alone, got 2 kinds"):
        metric_changes([splatnode.Marker(0.1), splatnode.Marker(0.1), splatnode.Marker(0.4)], False)
    with pytest.raises(ValueError, match="right must have one picture for each"):
        pairs_given(splatnode.Stereo(arrays[:2], 0.1), arrays, listed)
    with pytest.raises(TypeError, match="a session gets stereo pairs with add"):
        splatnode.Session(scale=stereo)
