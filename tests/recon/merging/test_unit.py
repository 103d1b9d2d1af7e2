"""The metres and the up of a merged map hold in all of its scenes, not in the first alone."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from splatnode.command_line import main
from splatnode.recon.merging import scale_and_up
from splatnode.recon.result.placement import IDENTITY, Placement
from splatnode.recon.result.submap_index import JoinedMap, MapSet, SubmapEdge, SubmapEntry, read_map_set
from splatnode.recon.result.verdict import Scale, Up
from tests.support.walk import write_walk

SOURCE = "marker 0 of 100 mm in 3 photographs, known to 1.1 %"
FIRST = {"scale": "metric", "scale_source": SOURCE, "scale_interval_95": [math.exp(-0.01), math.exp(0.01)]}
FRAME = {
    "frame": "upright",
    "frame_source": "gravity",
    "frame_sigma_deg": 0.3,
    "T_frame_first_camera": [[1.0, 0.0, 0.0, 0.25], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
}
UP = {"direction": [0.0, -1.0, 0.0], "sigma_deg": 0.3, "source": "gravity of 4 photographs"}
SCENES = ("scene-0001", "scene-0002", "scene-0003", "scene-0004")


def change(path: Path, **values: object) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def metric_walk(out: Path, **of_link: object) -> Path:
    """Two scenes, of which the first is in metres and knows where up is, and one link with these values more."""
    write_walk(out)
    change(out / "scene-0001" / "cameras.json", **FIRST)
    change(out / "scene-0001" / "report.json", up=UP)
    (link,) = json.loads((out / "places.json").read_text())["links"]
    change(out / "places.json", links=[{**link, **of_link}])
    return out


def whole_of(folder: Path, links: list[SubmapEdge]) -> tuple[MapSet, JoinedMap]:
    """The scenes in one world, of which `folder` has the first."""
    places = {each: SubmapEntry(each, folder / SCENES[0], "OK", "", True, False, ()) for each in SCENES}
    one = JoinedMap(SCENES[0], dict.fromkeys(SCENES, IDENTITY))
    return MapSet(places, tuple(links), (one,)), one


def link(first: int, second: int, sigma: float, retracted: str | None = None) -> SubmapEdge:
    return SubmapEdge(SCENES[first], SCENES[second], IDENTITY, "chain", retracted, sigma, 100 * sigma)


def test_a_merged_map_is_known_as_well_as_the_links_know_its_scenes(tmp_path):
    out = metric_walk(tmp_path / "out", sigma_scale=0.02, sigma_deg=0.4)
    change(out / "scene-0001" / "cameras.json", **FRAME)
    assert main(["merge", str(out)]) == 0
    folder = out / "map-scene-0001"
    told = json.loads((folder / "cameras.json").read_text())
    wide = math.hypot(0.01, 1.96 * 0.02)
    assert told["scale_interval_95"] == pytest.approx([math.exp(-wide), math.exp(wide)])
    assert (
        told["scale_source"] == f"{SOURCE}, in scene-0001; a further scene hangs on it by links, known to 4.2 % in all"
    )
    up = json.loads((folder / "report.json").read_text())["up"]
    assert up["sigma_deg"] == pytest.approx(0.5) and up["source"].endswith(", in scene-0001")
    assert told["frame"] == "upright" and told["frame_source"] == "gravity, in scene-0001"
    assert told["frame_sigma_deg"] == pytest.approx(0.5) and told["T_frame_first_camera"][0][3] == 0.25
    for name in ("levels.json", "report.json", "manifest.json"):
        assert json.loads((folder / name).read_text())["scale_interval_95"] == told["scale_interval_95"], name


@pytest.mark.parametrize("of_link", [{}, {"sigma_scale": None}, {"sigma_scale": 1e9, "sigma_deg": 1e9}])
def test_where_links_do_not_tell_how_sure_they_are_there_is_no_interval(tmp_path, of_link):
    whole = read_map_set(metric_walk(tmp_path / "out", **of_link))
    scale, up = scale_and_up(whole, whole.maps[0], SCENES[:2])
    assert scale.metric and scale.interval_95 is None
    assert (scale.source or "").endswith("by links, and how well the metres are known there is not told")
    assert up is not None and up.sigma_deg == (180.0 if of_link.get("sigma_deg") else 0.3)


def test_one_scene_alone_is_as_it_says(tmp_path):
    whole = read_map_set(metric_walk(tmp_path / "out", sigma_scale=0.02, sigma_deg=0.4))
    low, high = FIRST["scale_interval_95"]
    told = scale_and_up(whole, whole.maps[0], SCENES[:1])
    assert told == (Scale(True, SOURCE, (low, high)), Up((0.0, -1.0, 0.0), 0.3, "gravity of 4 photographs"))


def test_a_map_without_metres_gets_none(tmp_path):
    whole = read_map_set(write_walk(tmp_path / "out"))
    assert scale_and_up(whole, whole.maps[0], SCENES[:2]) == (Scale(), None)


def test_the_scene_that_is_known_worst_counts_along_the_links_that_count(tmp_path):
    folder = metric_walk(tmp_path / "out")

    def wide(links: list[SubmapEdge], scenes: tuple[str, ...] = SCENES) -> float | None:
        scale, _ = scale_and_up(*whole_of(folder, links), scenes)
        return scale.interval_95 and math.log(scale.interval_95[1])

    chain = [link(0, 1, 0.003), link(2, 1, 0.004), link(2, 3, 0.005)]  # one of them is the other way about
    assert wide(chain) == pytest.approx(math.hypot(0.01, 1.96 * math.sqrt(50) * 1e-3))
    assert wide(chain, SCENES[:3]) == pytest.approx(math.hypot(0.01, 1.96 * 0.005))
    loop = link(3, 0, 0.004)
    assert wide([*chain, loop]) == pytest.approx(math.hypot(0.01, 1.96 * 0.005))
    assert wide([*chain, link(3, 0, 0.004, "it does not close")]) == wide(chain)
    assert wide(chain[:2]) is None  # it is not told how the last scene hangs on the others


def test_in_a_chain_the_interval_has_the_true_length_as_often_as_it_says(tmp_path):
    rng = np.random.default_rng(5)
    chain = [link(0, 1, 0.003), link(1, 2, 0.01), link(2, 3, 0.005)]
    scale, _ = scale_and_up(*whole_of(metric_walk(tmp_path / "out"), chain), SCENES)
    assert scale.interval_95 is not None
    sigmas = np.array([0.01 / 1.96, *(each.sigma_scale or 0.0 for each in chain)])
    factors = np.exp(
        rng.normal(scale=sigmas, size=(20_000, 4)).sum(1)
    )  # true lengths in the last scene over stated ones
    low, high = scale.interval_95
    assert 0.945 < ((low <= factors) & (factors <= high)).mean() < 0.955


def test_links_are_read_with_how_sure_they_are(tmp_path):
    (read,) = read_map_set(metric_walk(tmp_path / "out", sigma_scale=0.02, sigma_deg=0.4)).links
    assert (read.sigma_scale, read.sigma_deg) == (0.02, 0.4) and isinstance(read.placement, Placement)
    (old,) = read_map_set(metric_walk(tmp_path / "old")).links
    assert (old.sigma_scale, old.sigma_deg) == (None, None)
