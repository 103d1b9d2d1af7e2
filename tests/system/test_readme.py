"""Every measured figure that README and docs/measurement.md print is that of its raw file in tests/bench/results.

Each test makes rows and phrases from the raw numbers, rounded as they are printed, and looks for them on the page.
"""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable, Iterable, Sequence
from statistics import mean, median, quantiles

import numpy as np
import pytest
from scipy.stats import spearmanr

from splatnode.recon.result import npz_files
from tests.conftest import ROOT
from tests.system import race_page

RESULTS = ROOT / "tests" / "bench" / "results"
MEASUREMENT, README = "docs/measurement.md", "README.md"

METHODS = ("preview", "fast", "balanced", "quality", "instantsplat-s", "instantsplat-xl", "paper")


def raw(name: str) -> dict:
    return json.loads((RESULTS / f"{name}.json").read_text())


def page(name: str) -> str:
    """The text of a page in one line: a phrase may be broken into lines anywhere."""
    return re.sub(r"\s+", " ", (ROOT / name).read_text(encoding="utf-8"))


def says(*phrases: str, on: str = MEASUREMENT) -> None:
    text = page(on)
    missing = [phrase for phrase in phrases if phrase not in text]
    assert not missing, f"{on} must say {missing}"


def part(value: float, digits: int) -> str:
    """0.8274 as .827, as the pages print what is below 1."""
    return f"{value:.{digits}f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.{digits}f}"


def change(value: float, digits: int = 1) -> str:
    return f"{'−' if value < 0 else '+'}{part(abs(value), digits)}"


def thousands(count: float) -> str:
    return f"{round(count, -3):,.0f}".replace(",", " ")


def ends(name: str, **wanted: object) -> list[dict]:
    """The final rows of a benchmark that have the wanted values."""
    rows = [row for row in raw(name)["rows"] if row["final"]]
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def over_sets(rows: Iterable[dict], value: Callable[[dict], float]) -> float:
    """The mean over sets of photographs of the mean over seeds."""
    sets: dict[tuple, list[float]] = {}
    for row in rows:
        sets.setdefault((row["scene"], row["views"]), []).append(value(row))
    return mean(mean(values) for values in sets.values())


def of_set(method: str, scene: str) -> float:
    """Mean PSNR over seeds in bench_7sets."""
    return mean(row["psnr"] for row in ends("bench_7sets", method=method, scene=scene))


@pytest.mark.parametrize("name, digits", [("bench_6views", 1), ("bench_7sets", 0)])
@pytest.mark.parametrize("method", METHODS)
def test_speed_and_accuracy(name, digits, method):
    rows = ends(name, method=method)
    score = {key: over_sets(rows, lambda row, key=key: row[key]) for key in ("psnr", "ssim", "lpips_alex")}
    gaussians = thousands(over_sets(rows, lambda row: row["num_gaussians"]))
    seconds = f"{over_sets(rows, lambda row: row['seconds']['total']):.{digits}f}"
    quality = f"{score['psnr']:.1f} dB | {part(score['ssim'], 3)} | {part(score['lpips_alex'], 3)}"
    says(f"| `{method}` | {quality} | {gaussians} | {seconds} |")


def test_the_sets_are_those_that_are_named():
    for name in ("bench_6views", "bench_7sets"):
        for row in ends(name):
            assert row["views"] == (12 if row["scene"] in ("castle_p30", "fox") else 6)
    assert {row["scene"] for row in ends("bench_6views")} == {"fountain_p11", "llff_fern", "sceaux"}
    assert len({row["scene"] for row in ends("bench_7sets")}) == 7
    assert not [row for row in ends("bench_7sets") if row["views"] == 3]  # the page says that there are none


def test_seeds():
    spreads = []
    for method in METHODS:
        for scene in {row["scene"] for row in ends("bench_7sets")}:
            values = [row["psnr"] for row in ends("bench_7sets", method=method, scene=scene)]
            assert len(values) in (1, 3)
            spreads += [max(values) - min(values)] if len(values) == 3 else []
    says(f"lie {part(min(spreads), 2)} to {part(max(spreads), 2)} dB apart")


def test_one_run_at_a_time():
    for row in raw("replay")["rows"]:
        scored = ends("bench_7sets", scene=row["scene"], views=row["views"], method=row["preset"], seed=0)
        quality = "not measured"
        if scored:
            quality = f"{scored[0]['psnr']:.1f} dB / {part(scored[0]['ssim'], 3)} / {part(scored[0]['lpips_alex'], 3)}"
        costs = f"{thousands(row['num_gaussians'])} | {row['peak_rss_mb'] / 1e3:.2f} GB | {row['seconds']['total']:.1f}"
        if row["scene"] != "fox":
            says(f"| {row['scene']}, {row['views']} views, `{row['preset']}` | {quality} | {costs} |")
    demo = raw("demo")
    held_out = f"{demo['held_out']['psnr']:.1f} dB / {part(demo['held_out']['ssim'], 3)} / not measured"
    says(
        f"| built-in capture, {demo['num_cameras']} views (`./run demo`) | {held_out} | "
        f"{thousands(demo['num_gaussians'])} | {demo['peak_rss_mb'] / 1e3:.2f} GB | not measured alone |"
    )


def test_the_rim():
    (row,) = ends("bench_7sets", scene="llff_fern", method="balanced", seed=0)
    says(f"`balanced` scores {row['psnr']:.1f} dB without the rim and {row['psnr_with_rim']:.1f} with it")


def test_what_is_said_of_instantsplat_and_paper():
    better = of_set("instantsplat-xl", "llff_flower") - of_set("balanced", "llff_flower")
    says(f"On llff_flower `instantsplat-xl` is {part(better, 1)} dB better than `balanced`")
    for scene in ("llff_flower", "llff_fern", "fox"):
        sharp, ours = (
            mean(row["lpips_alex"] for row in ends("bench_7sets", method=method, scene=scene))
            for method in ("instantsplat-xl", "balanced")
        )
        assert sharp < ours
    changes = {
        scene: change(of_set("paper", scene) - of_set("instantsplat-xl", scene))
        for scene in ("fountain_p11", "sceaux", "castle_p30", "llff_fern", "llff_flower", "tum_fr3_office", "fox")
    }
    first, *middle, last = (f"{value}{' dB' * (i == 0)} on {scene}" for i, (scene, value) in enumerate(changes.items()))
    says(f"`paper` changes PSNR by {', '.join([first, *middle])} and {last}.")
    alone = {row["method"]: row["psnr"] for row in ends("ablation_6views")}
    point, depth, normal = (
        change(alone[f"instantsplat-xl+{term}"] - alone["instantsplat-xl"], 2)
        for term in ("point-render", "depth", "normal")
    )
    says(f"loss alone changes it by {point} dB, the depth loss by {depth} and the normal loss by {normal}")


@pytest.mark.parametrize("method", ["fast", "colmap-3dgs", "colmap-fsgs", "cf-3dgs", "nope-nerf", "nerfmm"])
def test_rivals(method):
    rows = [ends("bench_rivals", method=method, scene=scene)[0] for scene in ("fountain_p11", "llff_fern")]
    scores = " | ".join(f"{row['psnr']:.1f} dB" for row in rows)
    errors = " | ".join(f"{row['rotation_error_deg']:.1f}°" for row in rows)
    name = "`nerfmm` (NeRF--)" if method == "nerfmm" else f"`{method}`"
    says(f"| {name} | {scores} | {errors} |")


def test_rivals_as_long_as_published():
    for row in raw("bench_published")["rows"]:
        psnr, ssim, lpips = (part(row[name], digits) for name, digits in (("psnr", 1), ("ssim", 3), ("lpips_alex", 3)))
        seconds = row["seconds"]["total"]  # None where others took more of the core than is allowed
        minutes = "not measured" if seconds is None else f"{seconds / 60:.0f}"
        size = thousands(row["num_gaussians"])
        says(f"| {row['scene']} | `{row['method']}` | {psnr} dB | {ssim} | {lpips} | {size} | {minutes} |")


def test_what_longer_runs_of_the_rivals_change():
    changes = {
        (row["scene"], method): row["psnr"] - ends("bench_rivals", method=method, scene=row["scene"])[0]["psnr"]
        for row in raw("bench_published")["rows"]
        for method in [row["method"].removesuffix("+published")]
    }
    fsgs = [changes.pop((scene, "colmap-fsgs")) for scene in ("llff_fern", "fountain_p11")]
    says(f"FSGS gains {part(fsgs[0], 1)} dB on llff_fern by it and loses {part(-fsgs[1], 1)} on fountain_p11")
    assert len(changes) == 4
    says(f"3DGS and CF-3DGS lose {-max(changes.values()):.0f} to {-min(changes.values()):.0f} dB")


def test_how_the_rivals_are_cut_down():
    from splatnode.recon.evaluate.rivals import cf_3dgs, colmap_3dgs, colmap_fsgs, nerfmm
    from splatnode.recon.optimize.control import adaptive

    assert colmap_3dgs.OPTIMIZE.iterations == colmap_fsgs.OPTIMIZE.iterations == nerfmm.OPTIMIZE.iterations == 1500
    assert (adaptive.Config().max_gaussians, nerfmm.OPTIMIZE.rays, nerfmm.SIZE) == (100_000, 384, 256)
    film = cf_3dgs.Config()
    says(f"CF-3DGS to {film.alone} iterations a frame, {film.motion} a motion and {film.final} at the end")


def test_merging():
    (one,) = raw("merge")["maps"]
    free, bounded = one["merged"]
    first, second = (
        tuple(mean(scores[scene].values()) for scores in (one["alone"], free["held_out"], bounded["held_out"]))
        for scene in ("scene-0001", "scene-0002")
    )
    given, kept = (f"{count:,}".replace(",", " ") for count in (free["gaussians_given"], free["num_gaussians"]))
    size = f"{free['bytes'] / 1e6:.1f} MB"
    says(
        f"{given} Gaussians became {kept} ({size}) in {free['seconds']:.0f} s",
        f"{first[0]:.1f} dB in the first scene alone and {first[1]:.1f} merged, {second[0]:.1f} and {second[1]:.1f}",
        f"with 20 000 Gaussians {first[2]:.1f} and {second[2]:.1f}",
    )


SIZES = {
    "a quarter": "x0.25",
    "half": "x0.5",
    "chosen": "chosen",
    "twice": "x2",
    "four times": "x4",
    "as many by MCMC": "mcmc",
    "a Gaussian a pixel": "pixel",
}


@pytest.mark.parametrize("name, method", SIZES.items())
def test_size(name, method):
    rows = [row for row in raw("parsimony")["rows"] if row["method"] == method]
    psnr, ssim, lpips, count = (mean(row[key] for row in rows) for key in ("psnr", "ssim", "lpips", "num_gaussians"))
    says(f"| {name} | {psnr:.1f} dB | {part(ssim, 3)} | {part(lpips, 3)} | {thousands(count)} |")


def test_where_another_size_is_better():
    found = raw("parsimony")
    by_case: dict[tuple[str, int], dict[str, dict]] = {}
    for row in found["rows"]:
        by_case.setdefault((row["scene"], row["views"]), {})[row["method"]] = row
    gains = {case: rows["pixel"]["psnr"] - rows["chosen"]["psnr"] for case, rows in by_case.items()}
    worse = {("llff_fern", 6), ("llff_flower", 3), ("llff_flower", 6), ("sceaux", 3), ("castle_p30", 6)}
    assert {case for case, gain in gains.items() if gain > 0} == worse
    flower = " and ".join(part(gains["llff_flower", views], 1) for views in (3, 6))
    says(
        f"llff_fern at 6 views ({part(gains['llff_fern', 6], 1)} dB), llff_flower at 3 and 6 ({flower}), "
        f"sceaux at 3 ({part(gains['sceaux', 3], 1)}) and castle_p30 at 6 ({part(gains['castle_p30', 6], 1)})"
    )
    castle = by_case["castle_p30", 6]
    mcmc = castle["mcmc"]["psnr"] - castle["chosen"]["psnr"]
    says(
        f"With 6 a Gaussian a pixel is {gains['castle_p30', 6]:.1f} dB better there than splatnode, "
        f"and MCMC of splatnode's size {mcmc:.1f} dB."
    )
    summary = found["summary"]
    says(f"In {summary['on_front']['together']} of the {summary['cases']} cases no other row")
    chosen = [rows["chosen"] for rows in by_case.values()]
    a_gaussian = mean(row["spz_bytes"] / row["num_gaussians"] for row in chosen)
    says(f"6 views takes {summary['spz_mb_6_views']:.2f} MB as `.spz`, {a_gaussian:.0f} bytes a Gaussian")
    kept = [row["psnr_to_ply"] for row in raw("spz")["rows"]]
    assert len(kept) == 4
    says(f"renders of four scenes keep {min(kept):.0f} to {max(kept):.0f} dB")


def test_half_and_twice_the_size_on_the_sets_of_the_race():
    found = raw("parsimony_race")
    scores = {(row["scene"], row["views"], row["method"]): row for row in found["rows"]}
    sets = dict.fromkeys(each[:2] for each in scores)

    def changes(method: str) -> str:
        """In the mean."""
        pairs = [(scores[(*each, method)], scores[(*each, "chosen")]) for each in sets]
        psnr, ssim, lpips = (mean(other[k] - own[k] for other, own in pairs) for k in ("psnr", "ssim", "lpips"))
        return f"{change(psnr, 2)} dB / {change(ssim, 3)} / {change(lpips, 3)}".replace("−.00 dB", "0 dB")

    psnr, ssim, lpips = (found["summary"]["twice_is_better"][measure] for measure in ("psnr", "ssim", "lpips"))
    says(
        f"On {len(sets)} sets of [the race](#the-race-sets-that-nothing-was-tuned-on) (`parsimony_race.json`) "
        f"half of the size is worse in at least two of the three measures in {found['summary']['half_is_worse']}. "
        f"Twice the size is better by more than .1 dB in {psnr}, by more than .003 in SSIM in {ssim}, by more than 2 % "
        f"in LPIPS in {lpips}. In the mean half changes PSNR / SSIM / LPIPS by {changes('x0.5')}, twice by "
        f"{changes('x2')}: what more Gaussians bring is texture, and `quality` has more."
    )


def test_budgets():
    found = raw("budgets")
    psnr = {(row["scene"], row["limit"], row["value"]): row["psnr"] for row in found["rows"]}
    after = [psnr["fountain_p11", "iterations", count] for count in (25, 100, 500)]
    says(f"worth {after[0]:.1f} dB after 25 iterations, {after[1]:.1f} after 100 and {after[2]:.1f} after 500")
    falls = [re.fullmatch(r"fountain_p11 6, .* psnr ([\d.]+) to ([\d.]+)", fall) for fall in found["falls"]]
    assert all(fall and 0.05 <= float(fall[1]) - float(fall[2]) < 0.15 for fall in falls)


def test_windows():
    summary = raw("windows")["summary"]
    titles = {"splatnode": "splatnode", "colmap": "COLMAP", "glomap": "GLOMAP"}
    for method, title in titles.items():
        found = summary[method]["all"]
        counts = [found[kind] for kind in ("right", "right_part", "between", "wrong", "refused")]
        says(f"| {title} | {' | '.join(map(str, counts))} |")
    says(f"Of {summary['splatnode']['all']['sets']} windows")
    judged = raw("fit")
    many, pairs = (judged[kind]["cross_validated"] for kind in ("many", "pair"))
    windows, by_count = many["windows"], many["windows_by_count"]
    says(f"it publishes {windows['right_published']} of {windows['right']} such sets (`fit.json`)")
    says(f"hold for {windows['rotations_within']:.0%} of".replace("%", " %"))
    says(f"{windows['centres_within']:.0%} of their centres".replace("%", " %"))
    shares = [
        f"{by_count[n]['rotations_within']:.0%} and {by_count[n]['centres_within']:.0%}" for n in ("3", "6", "12")
    ]
    three, six, twelve = (share.replace("% and", " and").replace("%", " %") for share in shares)
    says(f"{three} at 3 views, {six} at 6, {twelve} at 12")
    says(f"in {pairs['windows']['right_published']} of {pairs['windows']['right']} sets")
    assert pairs["windows"]["beyond"] == 0 and windows["beyond"] == 0
    told = many["windows_told"]
    says(f"{told['right_published']} of {told['right']} right sets are published, {told['beyond']} beyond the claim")


def test_windows_again():
    found = raw("windows_again")["summary"]["splatnode"]["all"]
    says(f"{found['right']} right, {found['right_part']} right in part, {found['between']} between")
    says(f"{found['wrong']} wrong, {found['refused']} refused")


def test_stream():
    stream = raw("stream")
    assert stream["in_a_scene"] == stream["photographs"] == 40 and not stream["in_no_list"]
    castle, fox = (place["psnr"] for place in stream["places"])
    offline = stream["offline"]
    assert abs(castle - offline["castle_p30"]["psnr"]) < 0.005
    says(f"castle {castle:.1f} dB, as offline; fox {fox:.1f} dB, offline {offline['fox']['psnr']:.1f}")
    says(f"all finished {stream['all_finished_s'] - stream['taken_s']:.0f} s after the last photograph")
    says(f"{stream['delay_s_median']:.0f} s behind the camera in the median, {stream['delay_s_most']:.0f} s at most")


def test_fast_stream():
    fast = raw("stream_fast")
    assert fast["in_a_scene"] == fast["photographs"] == 60 and len(fast["places"]) == 2
    castle, fox = (fast["cameras"][name] for name in ("castle_p30", "fox"))
    says(f"cameras within {castle['rotation_deg']:.2f} degrees and {castle['centre_pct']:.2f} % of the true ones")
    says(f"in castle, {fox['rotation_deg']:.2f} and {fox['centre_pct']:.2f} in fox")
    says(
        f"picture {fast['delay_s_median']:.0f} s behind the camera in the median, {fast['delay_s_most']:.0f} s at most"
    )
    says(f"all finished {fast['all_finished_s'] - fast['taken_s']:.0f} s after the last photograph")
    says(f"recon's memory at most {fast['recon_mb_most'] / 1e3:.2f} GB")


def test_stream_of_five_places():
    five = raw("stream_five")
    assert (five["photographs"], five["in_a_scene"], len(five["in_no_list"])) == (74, 72, 2)
    assert [cameras["scenes"] for cameras in five["cameras"].values()] == [1] * 5 == [1] * len(five["places"])
    rotation, centre = (max(each[what] for each in five["cameras"].values()) for what in ("rotation_deg", "centre_pct"))
    says(f"cameras within {rotation:.2f} degrees and {centre:.2f} % of the true ones")
    says(f"{five['delay_s_median']:.0f} s behind the camera in the median, {five['delay_s_most']:.0f} s at most")


def test_stream_there_and_back():
    back = raw("stream_back")
    visits, cameras = back["visits"], back["cameras"]
    assert back["photographs"] == back["in_a_scene"] == 72 and visits["joined"] == []
    says(f"{len(visits['recognised'])} of the {len(visits['found_there'])} places recognised on the way back")
    known = [cameras[name] for name in visits["recognised"]]
    rotation, centre = (max(each[what] for each in known) for what in ("rotation_deg", "centre_pct"))
    says(f"within {rotation:.2f} degrees and {centre:.2f} % of the true ones; all finished")
    says(f"all finished {back['all_finished_s'] - back['taken_s']:.0f} s after the last photograph")
    says(f"recon's memory at most {back['recon_mb_most'] / 1e3:.2f} GB")


def test_stream_of_all_places_there_and_back():
    every = raw("stream_all")
    visits, cameras = every["visits"], every["cameras"]
    assert len(cameras) == 17 and visits["joined"] == [["castle_p30", "entry_p10", "fountain_p11"]]
    says(f"{every['photographs']} photographs of all 17 real scenes")
    says(f"{len(visits['found_there'])} of the 17 places found on the way there, {len(visits['recognised'])} of these")
    assert set(visits["recognised"]) < set(visits["found_there"])
    used = {name for place in every["places"] for name in place["frames_used"]}
    left_out, unlisted = len(every["left_out_by_name"].keys() - used), len(every["in_no_list"])
    assert every["in_a_scene"] + left_out + unlisted == every["photographs"]
    says(f"{every['in_a_scene']} photographs in a scene, {left_out} named with the reason, {unlisted} left out by")
    known = [cameras[name] for name in visits["recognised"]]
    rotation, centre = (max(each[what] for each in known) for what in ("rotation_deg", "centre_pct"))
    says(f"of both visits, within {rotation:.2f} degrees and {centre:.2f} % of the true ones; picture")
    says(f"{every['delay_s_median']:.0f} s behind the camera in the median, {every['delay_s_most']:.0f} s at most; all")
    says(f"all judged {every['all_finished_s'] - every['taken_s']:.0f} s after the last photograph; recon's")
    says(f"recon's memory at most {every['recon_mb_most'] / 1e3:.2f} GB")


def test_a_walk_through_the_building():
    walk = raw("building")
    cameras, loops, cost = walk["cameras"], walk["loops"], walk["cost"]
    says(f"a walk of {walk['keyframes']} keyframes, {cameras['path_m']:.0f} m, through the built-in building")
    assert walk["in_a_scene"] == walk["keyframes"] and walk["all_finished_s"] is None
    says(f"all in a scene, in {walk['scenes']} scenes")
    of_the_way, most = cameras["position_percent_of_path"], cameras["rotation_deg_most"]
    says(f"cameras within {of_the_way:.3f} % of the way and {most:.2f} degrees of the true ones")
    assert loops["linked_or_in_one_map"] == loops["revisits"] and not loops["wrong_loop_links"]
    says(f"all {loops['revisits']} revisits in one map; of {loops['loop_links']} loops none wrong")
    seconds, delay = cost["second"], cost["delay_s"]
    says(f"{seconds['median']:.1f} s a keyframe in the median, {seconds['percentile_95']:.1f} in the 95th percentile")
    says(f"picture {delay['median']:.0f} s behind the camera in the median, {delay['most']:.0f} s at most")
    says(f"{cost['checkpoint_mb']['growth_per_keyframe']:.1f} MB of disk a keyframe")
    walked = max(sample["rss_mb"] for sample in cost["samples"] if sample["done"] < walk["keyframes"]) / 1e3
    says(f"at most {walked:.2f} GB on the way, {cost['rss_mb']['most'] / 1e3:.2f} GB while scenes were finished")


def test_faults_on_a_walk():
    walk = raw("walk_faults")
    faults = walk["faults"].values()
    tried = sum(fault["tried"] for fault in faults)
    assert len(faults) == 12 and {fault["tried"] for fault in faults} == {5} == {fault["good"] for fault in faults}
    assert not walk["in_no_list"] and walk["maps"] == 1 and not walk["loops"]["wrong_loop_links"]
    says(f"one walk of {walk['photographs']} keyframes through the built-in building, five times each")
    named = walk["photographs"] - walk["in_a_scene"]
    says(f"after all {tried} the node went on; {walk['in_a_scene']} photographs in one map, the other {named} named")
    says(f"{walk['loops']['loop_links']} loops, none wrong; cameras within ")
    says(f"{walk['cameras']['position_percent_of_path']:.3f} % of the way | `walk_faults.json` |")


def test_memory_of_a_walk():
    walk = raw("building_120")
    cost, loops = walk["cost"], walk["loops"]
    assert walk["in_a_scene"] == walk["keyframes"] == 120
    assert not loops["wrong_loop_links"] and not loops["wrong_chain_links"]
    says(f"all in a scene, in {walk['scenes']} scenes, {loops['loop_links']} loops, none wrong")
    walked = max(sample["rss_mb"] for sample in cost["samples"] if sample["done"] < walk["keyframes"]) / 1e3
    says(f"{walked:.2f} GB on the way, {cost['rss_mb']['most'] / 1e3:.2f} GB while scenes were finished; ")
    seconds = cost["processor_s"]
    says(f"{seconds['median']:.1f} s of processor a keyframe in the median, {seconds['percentile_95']:.1f} in the 95th")


def test_the_first_room():
    room = raw("building_50")["first_room"]
    alone = room["alone"]
    assert alone["psnr"] - room["psnr"] < 0.3
    says(f"{room['psnr']:.1f} dB with {room['gaussians']} Gaussians in its scene of the walk")
    says(f"{alone['psnr']:.1f} dB with {alone['gaussians']} where the same photographs are reconstructed offline")


def test_a_film_of_the_building():
    film = raw("film")
    live, offline = film["live"], film["offline"]
    assert live["maps"] == offline["maps"] == 1
    assert not live["loops"]["wrong_loop_links"] and not offline["loops"]["wrong_loop_links"]
    says(f"live {live['in_a_scene']} of {live['keyframes']} keyframes in {live['scenes']} scenes")
    says(f"offline {offline['in_a_scene']} of {offline['keyframes']} in {offline['scenes']}; cameras")
    for name, run in (("live", live), ("offline", offline)):
        cameras = run["cameras"]
        of_the_way, most = cameras["position_percent_of_path"], cameras["rotation_deg_most"]
        way = " of the way" if run is live else ""
        says(f"{of_the_way:.3f} %{way} and {most:.2f} degrees {name}")
    a_keyframe = [run["processor_s"] / run["keyframes"] for run in (live, offline)]
    says(f"{a_keyframe[0]:.1f} s of processor a keyframe live, {a_keyframe[1]:.1f} offline")
    says(f"in all {film['offline_over_live']:.2f} times as much")
    says(f"recon's memory at most {live['peak_mb'] / 1e3:.2f} GB live")


def test_stream_of_a_chain():
    chain = raw("stream_chain")
    assert chain["in_a_scene"] == chain["photographs"] == 30 and len(chain["places"]) == 3
    cameras = chain["cameras"]["castle_p30"]
    assert cameras["linked"] == 3 and cameras["cameras"] == 30
    says(f"within {cameras['rotation_deg']:.2f} degrees and {cameras['centre_pct']:.2f} % of the true ones")
    says(f"{chain['delay_s_median']:.1f} s behind the camera in the median, {chain['delay_s_most']:.1f} s at most")


def test_growth():
    rows = raw("growth")["rows"]
    assert [row["views"] for row in rows] == [3, 6, 12, 24, 48]

    def listed_seconds(values: list[float]) -> str:
        return ", ".join(f"{value:.0f}" if value >= 10 else f"{value:.1f}" for value in values)

    says(f"all takes {listed_seconds([row['seconds']['total'] for row in rows])} seconds")
    says(f"verification take {listed_seconds([row['seconds']['poses'] for row in rows])}.")
    says(f"after {listed_seconds([row['first_scene_s'] for row in rows])} seconds")
    gigabytes = [f"{row['peak_rss_mb'] / 1e3:.2f}" for row in rows]
    says(f"Peak memory is {', '.join(gigabytes)} GB")


def test_a_walk_of_a_thousand_keyframes():
    walk = raw("building_1000")
    cameras, cost, loops = walk["cameras"], walk["cost"], walk["loops"]
    says(f"the same for {walk['keyframes']} keyframes, {cameras['path_m']:.0f} m")
    says(f"{walk['in_a_scene']} in a scene, in {walk['scenes']} scenes")
    says(
        f"within {cameras['position_percent_of_path']:.3f} % of the way and {cameras['rotation_deg_most']:.2f} degrees"
    )
    seconds = cost["processor_s"]
    says(f"{seconds['median']:.1f} s of processor a keyframe in the median, {seconds['percentile_95']:.1f} in the 95th")
    says(f"(the running median by {100 * seconds['slope_of_median_per_100']:.1f} % a hundred keyframes)")
    memory = cost["rss_mb"]
    says(f"at most {walk['memory_on_the_way_mb'] / 1e3:.2f} GB on the way, {memory['growth_per_keyframe']:.2f} MB more")
    disk = cost["checkpoint_mb"]["growth_per_keyframe"]
    says(f"{memory['most'] / 1e3:.2f} GB while scenes were finished; {disk:.1f} MB of disk")
    final = sum(not place["provisional"] for place in walk["places"])
    says(f"when {final} scenes were final: of {loops['loop_links']} loops none wrong")
    assert loops["wrong_loop_links"] == loops["wrong_chain_links"] == 0


def test_the_map_of_a_thousand_keyframes():
    walk = raw("building_1000_judged")
    cameras, loops = walk["cameras"], walk["loops"]
    assert walk["maps"] == 1 and loops["linked_or_in_one_map"] == loops["revisits"]
    assert loops["wrong_loop_links"] == loops["wrong_chain_links"] == 0
    says(
        f"one map of {walk['scenes']} scenes; cameras within {cameras['position_percent_of_path']:.4f} % of the way "
        f"and {cameras['rotation_deg_most']:.2f} degrees; all {loops['revisits']} revisits in it, "
        f"{loops['linked']} of them by a loop of their own; {loops['loop_links']} loops, none wrong; "
        f"{loops['retracted']} more"
    )


def test_trust():
    poses = raw("poses")
    total, rows = poses["summary"], poses["rows"]
    scenes = len({row["scene"] for row in rows})
    says(f"Of {total['sets']} sets of 3, 6 and 12 views from {scenes} real scenes with known cameras")
    says(f"{total['published']} were published, {total['right']} of them right within 2° and 5 %")
    says(f"and {len(total['false_accepts'])} beyond its claim")
    stages = ("features", "matching", "mapping", "verification")
    seconds = [
        median(sum(row[f"seconds_{stage}"] for stage in stages) for row in rows if row["views"] == views)
        for views in (3, 6, 12)
    ]
    says(f"take {seconds[0]:.1f}, {seconds[1]:.1f} and {seconds[2]:.1f} seconds in the median at 3, 6 and 12 views")
    depth = [row["seconds"]["points"] / row["views"] for row in raw("replay")["rows"]]
    says(f"depth maps take {part(min(depth), 1)} to {part(max(depth), 1)} seconds a view")


def test_stability():
    found = raw("stability")
    trials = [trial for trial in found["trials"] if trial["method"] == "splatnode"]
    summary = found["methods"][0]
    kinds, seeds = len({trial["name"] for trial in trials}), len({trial["seed"] for trial in trials})
    says(f"Of {len(trials)} trials of the stability matrix (`stability.json`, {kinds} kinds of")
    says(f"trials with {seeds} seeds)")
    says(f"{summary['false_accept']['count']} published a scene beyond its claim")
    low, high = found["false_accept_interval"]
    says(f"({low:.1%} to {high:.1%} with 95 % confidence)".replace("%", " %", 2).replace("0.0 % to", "0 to"))
    refused = [trial for trial in trials if trial["outcome"] == "false_refuse"]
    says(f"In {len(refused)} of the {summary['false_refuse']['of']} trials that deserved a scene there was none")


def test_photographs_in_doubt():
    trials = raw("doubtful")["trials"]
    partial = [trial for trial in trials if trial["verdict"] == "OK_PARTIAL"]
    says(f"Of {len(trials)} trials of the kinds that this concerns (`doubtful.json`), {len(partial)} were published")
    assert max(trial["rotation_error_deg"] for trial in partial) < 0.7
    assert max(trial["centre_error_pct"] for trial in partial) < 0.5
    (wrong,) = [trial for trial in trials if trial["outcome"] == "false_accept"]
    assert (wrong["name"], wrong["verdict"], wrong["num_cameras"]) == ("two places", "OK", 7)
    says("The 1 that counts as a wrong scene, of two places, is one courtyard")
    assert wrong["rotation_error_deg"] < 0.2 and wrong["centre_error_pct"] < 0.2


def test_stability_of_the_rivals():
    found = {method["method"]: method for method in raw("stability_rivals")["methods"]}
    wrong = [found[name]["false_accept"]["count"] for name in ("splatnode", "colmap", "glomap")]
    says(f"Of the {found['glomap']['trials']} kinds with one seed, splatnode published {wrong[0]} wrong scenes")
    says(f"COLMAP {wrong[1]} and GLOMAP {wrong[2]}")


def test_live():
    rows = raw("live")["rows"]
    assert [row["scene"] for row in rows] == ["fox", "llff_flower", "tum_fr3_office"]
    assert all(row["live_psnr"] == row["offline_psnr"] for row in rows)
    first, further = (", ".join(f"{row[key]:.1f}" for row in rows) for key in ("first_scene_s", "further_s_p95"))
    says(f"| {first} s | `live.json` |", f"same sets | {further} s | `live.json` |")
    says(f"besides decoding | {part(raw('capture')['besides_decoding'], 2)} of a core |")
    pushed = raw("publisher")
    each = pushed["median_ms_a_frame"]
    assert pushed["publisher_over_camera"] <= 0.05
    less = -100 * pushed["publisher_over_camera"]
    says(f"{each['publisher']:.2f} ms of processor a frame against {each['camera']:.2f}: {less:.1f} % less")
    soak = raw("soak")
    assert soak["previews_lost"] == 0 and max(soak["memory_change"].values()) < 0.01
    says(f"previews within {soak['preview_latency_ms']['p99']:.0f} ms (99th percentile) | `soak.json` |")
    faults = raw("faults")["faults"].values()
    tried, good = sum(fault["tried"] for fault in faults), sum(fault["good"] for fault in faults)
    assert tried == good
    says(f"| {len(faults)} faults, from kill -9 to a wrong key, 20 times each | all {tried} trials ended")
    for queue in (raw("queue")["two_ends"], raw("queue")["processes"]):
        acknowledged, refused = queue["messages"] - queue["refused"], queue["refused"]
        assert queue["acknowledged"] == acknowledged and queue["refused_and_named"] == refused and not queue["left"]
        says(f"a queue of {queue['messages']} keyframes of which every third is refused")
        says(f"the other {acknowledged} acknowledged, all {refused} named, nothing restarted | `queue.json` |")
    assert set(raw("queue")["processes"]["exit_codes"].values()) == {0}
    sieges = [raw("siege_ipc"), raw("siege_tcp")]
    assert all(siege["previews_lost"] == 0 and set(siege["exit_codes"].values()) == {0} for siege in sieges)
    p99, p50 = (
        " and ".join(f"{siege[f'{name}_hostile_over_quiet'][figure]:.2f}" for siege in sieges)
        for name, figure in (("preview_ms", "p99"), ("keyframe_s", "p50"))
    )
    says(f"the 99th percentile of previews {p99} times that of quiet phases, the median of keyframes {p50} times |")
    pieces = raw("writes")["pieces"].values()
    runs = sum(sum(piece["runs"].values()) for piece in pieces)
    assert runs == sum(piece["good"] for piece in pieces)
    says(f"and kill -9: {sum(piece['points'] for piece in pieces)} points | all {runs} runs left the old whole")
    fuzz = raw("fuzz")["campaigns"]["boundaries"]
    attacked, defects = len(fuzz["rows"]), fuzz["defects"]
    assert sum(row["cases"] for row in fuzz["rows"].values()) == fuzz["cases"]
    told = f"{defects} defect{'s' * (defects != 1)}"
    says(f"| {fuzz['cases'] / 1e6:.1f} million structured cases on {attacked} boundaries | {told}")


def test_viewer():
    for name in ("viewer_hour", "viewer_live"):
        live = raw(name)["live"]
        assert live["not_seen_within_10_s"] == 0
        late, memory = live["latency_ms"]["percentile_95"] / 1e3, live["memory_mb"]["at_the_end"]
        assert memory >= max(live["memory_mb"]["median_of_each_twentieth"])
        says(
            f"all of {live['updates']} updates shown, 95 % within {late:.2f} s, "
            f"memory at most {memory} MB | `{name}.json` |"
        )
    beside = raw("beside")
    intake, steps = (beside["ratios"][kind]["viewer"] for kind in ("intake_per_s", "iterations_per_s"))
    says(
        f"{beside['taken']:.0%}".replace("%", " %") + " of both cores; "
        f"keyframes taken in {part(intake['median'], 2)} times as fast in the median of {intake['rounds']} rounds "
        f"({span(intake['range'])}), iterations {steps['median']:.2f} ({span(steps['range'])})"
    )
    viewer = raw("viewer")
    points, splats = (viewer["pictures"][f"core {kind}"]["per_second_median"] for kind in ("points", "Gaussians"))
    says(f"| {thousands(viewer['gaussians'])} points, Gaussians in the window, software Vulkan | ")
    says(f"| {points:.0f}, {splats:.0f} pictures a second |")
    agreement = viewer["agreement"]
    says(f"differ by {agreement['mean']:.1f} of 255 levels in the mean ({len(agreement['cameras'])} cameras")


def span(ends: Sequence[float]) -> str:
    return " to ".join(part(end, 2) for end in ends)


def test_further_photographs():
    found = raw("locate")
    sums, trials = found["summary"], found["trials"]
    covered = [trial for trial in trials if trial["covered"]]
    placed = [trial for trial in trials if trial["outcome"] == "placed"]
    sets = {(trial["scene"], trial["views"]) for trial in trials}
    says(f"photographs of {len(sets)} sets of 6 and 12 views from {len({scene for scene, _ in sets})} real scenes")
    says(f"| {len(trials)}, of which {len(covered)} share 30 matches")

    def right(trial: dict) -> bool:
        return trial["outcome"] == "placed" and trial["rotation_deg"] <= 1 and trial["centre_percent"] <= 1

    exact = sum(map(right, covered))
    assert (exact, len(placed)) == (sums["covered_and_right"], sums["placed"])
    says(f"of these {len(covered)}, placed within", f"| {exact} ({100 * exact / len(covered):.0f} %) |")
    most = [max(trial[key] for trial in placed) for key in ("rotation_deg", "centre_percent")]
    says(f"| {len(placed)}; {most[0]:.2f} degrees, {most[1]:.2f} % of the distance |")

    def beyond(kind: str, unit: str, trial: dict) -> bool:
        return trial[f"{kind}_{unit}"] > trial[f"{kind}_claim_{unit}"]

    turned = sum(beyond("rotation", "deg", trial) for trial in placed)
    moved = [trial["scene"] for trial in placed if beyond("centre", "percent", trial)]
    shares = [100 * (1 - count / len(placed)) for count in (turned, len(moved))]
    says(f"for {shares[0]:.0f} % of the rotations, {shares[1]:.0f} % of the centres")
    kitti = moved.count("hard_kitti_forward1")
    says(f"{kitti} of the {len(moved)} centres beyond their bounds are of hard_kitti_forward1")
    elsewhere = sum(trial["scene"] != "hard_kitti_forward1" for trial in placed)
    says(f"Elsewhere {len(moved) - kitti} of {elsewhere} is beyond its bound")
    inexact = [trial for trial in covered if not right(trial)]
    off = sorted(trial["centre_percent"] for trial in inexact if trial["outcome"] == "placed")
    assert (len(inexact), len(off)) == (7, 6)
    says("Of the 7 photographs", f"one was refused, and six are {off[0]:.1f} to {off[-1]:.1f} % off")


def test_photographs_of_other_scenes():
    found = raw("locate")
    strangers = [pair["outcome"] == "placed" for pair in found["strangers"] if not pair["same_place"]]
    courtyard = [pair["outcome"] == "placed" for pair in found["strangers"] if pair["same_place"]]
    says(f"| photographs of other scenes | {sum(strangers)} of {len(strangers)} placed |")
    says(f"Of their {len(courtyard)} pairs {sum(courtyard)} were placed")
    seconds = [trial["seconds"] for trial in found["trials"] if trial["seconds"] is not None]
    says(f"| seconds of one core, at 800 pixels | {median(seconds):.2f} in the median, {max(seconds):.2f} at most |")
    following = [trial["seconds_following"] for trial in found["trials"] if trial["seconds_following"] is not None]
    says(f"degrees away | {median(following):.2f} in the median, {max(following):.2f} at most |")
    apart = [pair["outcome_following"] == "placed" for pair in found["strangers"] if not pair["same_place"]]
    says(f"| the same near to cameras of the scene (`near`) | {sum(apart)} of {len(apart)} placed |")
    frames = [frame["seconds"] for frame in found["frames"]]
    assert all(frame["quickly"] for frame in found["frames"])
    says(f"near to the one before | {median(frames):.2f} in the median, {max(frames):.2f} at most; {len(frames)} of")


QUERIES = {
    "zoomed 1.02 to 1.3 times": [f"zoom {factor}" for factor in (1.02, 1.05, 1.1, 1.2, 1.3)],
    "zoomed 1.6 and 2 times": ["zoom 1.6", "zoom 2.0"],
    "zoomed 2.5 and 3 times": ["zoom 2.5", "zoom 3.0"],
    "cropped to 80 %, in the middle and at a corner": ["cut middle 0.8", "cut corner 0.8", "crop corner 0.8"],
    "mirrored": ["mirror"],
    "with black borders, at 75 %": ["letterbox 0.75"],
    "stretched by 1.1, squeezed to 75 %": ["stretch 1.1", "squeeze 0.75"],
    "bent by k1 of −.15 and .1": ["bend -0.15", "bend 0.1"],
    "blurred by motion over 2 % of the width": ["blur 0.02"],
    "halves that changed places": ["collage"],
    "as they are": ["clean"],
    "as they are, with EXIF": ["clean exif"],
    "as they are, with the lens given": ["clean given"],
    "zoomed 1.1, 1.3 and 2 times, with EXIF of the whole": ["zoom 1.1 exif", "zoom 1.3 exif", "zoom 2.0 exif"],
    "the same, with the lens of the whole given": ["zoom 1.1 given", "zoom 1.3 given", "zoom 2.0 given"],
}  # fmt: skip


def test_query_images_of_another_lens():
    sums = raw("query_lenses")["summary"]
    for words, warps in QUERIES.items():
        cells = [sum(sums["all"]["kinds"][warp][count] for warp in warps) for count in ("queries", "placed", "wrong")]
        says(f"| {words} | {cells[0]} | {cells[1]} | {cells[2]} |")
    every, halves = sums["all"], (sums["chosen_on"], sums["left_out"])
    says(f"Of {every['queries']} zoomed, cropped and mirrored queries {every['wrong']} were wrong")
    wrong, placed = ([half[key] for half in halves] for key in ("wrong", "zoomed_placed"))
    shares = [100 * half["zoomed_placed"] / half["zoomed"] for half in halves]
    says(f"{wrong[0]} on the scenes that thresholds were chosen on and {wrong[1]} on the others")
    says(f"placed are {placed[0]} ({shares[0]:.0f} %) and {placed[1]} ({shares[1]:.0f} %)")
    within = [100 * every["within"][kind] for kind in ("rotation", "centre", "focal")]
    says(f"{within[0]:.0f} % of the rotations, {within[1]:.0f} % of the centres and {within[2]:.0f} % of the focal")


MAPPED = {
    "built-in capture": "built-in capture, 3 places",
    "building": "built-in building, 2 rooms",
    "glass": "built-in capture with a pane of glass",
    "mirror": "built-in building, at a mirror",
}


@pytest.mark.parametrize("start", MAPPED)
@pytest.mark.parametrize("views", [3, 6, 12])
def test_free_space(start, views):
    rows = [row for row in raw("occupancy")["rows"] if row["place"].startswith(start) and row["views"] == views]
    assert len(rows) == {"built-in capture": 3, "building": 2}.get(start, 1)

    def percents(key: str, digits: int) -> str:
        ends = [f"{100 * end(row[key] for row in rows):.{digits}f}" for end in (min, max)]
        return f"{' to '.join(dict.fromkeys(ends))} %"

    shares = [percents("free_solid", 3), *(percents(key, 0) for key in ("found", "found_near", "unknown"))]
    says(f"| {MAPPED[start]} | {views} | {' | '.join(shares)} |")


def test_free_space_of_a_walk():
    (row,) = raw("walk_occupancy")["rows"]
    assert row["verdict"] == "OK" and row["free_solid"] < 0.001
    shares = " | ".join(f"{100 * row[key]:.0f} %" for key in ("found", "found_near", "unknown"))
    place = f"built-in building, {row['place'].removeprefix('building, ')}, merged"
    says(f"| {place} | {row['placed']} | {100 * row['free_solid']:.3f} % | {shares} |")
    says(f"Its map takes {row['seconds']:.1f} s")


def test_free_space_in_all():
    rows = raw("occupancy")["rows"]
    plain = [row for row in rows if row["place"] not in ("glass", "mirror")]
    most, enough = max(row["free_solid"] for row in plain), sum(row["found"] >= 0.9 for row in plain)
    assert most < 0.001
    says(f"at most {100 * most:.3f} % of what is called free is solid")
    says(f"At least 90 % of the surface is found in {enough} of these {len(plain)} rows")
    on_floor = [row for row in rows if row["floor_error_metres"] is not None]
    up, floor = (max(row[key] for row in on_floor) for key in ("up_error_deg", "floor_error_metres"))
    says(f"in {len(on_floor)} of {len(rows)} rows, up is right within {up:.2f} degrees")
    says(f"degrees and the floor within {100 * floor:.1f} cm")
    alone = max(row["up_error_deg"] for row in rows if row["floor_error_metres"] is None)
    says(f"by the cameras alone up was {alone:.1f} degrees off at worst")
    says(f"A map takes up to {max(row['seconds'] for row in rows):.1f} s of one core")


LEAST = "turn_deg", "shift_percent"  # moves that an audit would have noticed


def test_cameras_that_moved():
    checks = raw("audit")["checks"]
    real = {each["scene"] for each in checks} - {"built-in"}
    unseen = {name for name in real if name.startswith("hard") or name in ("kitchen", "goldcape")}
    assert (len(real), len(unseen)) == (12, 5)

    def of(kind: str) -> list[list[dict]]:
        """Those of the scenes that something was chosen on, and of the others."""
        here = [each for each in checks if each["kind"] == kind]
        return [[each for each in here if (each["scene"] in unseen) == new] for new in (False, True)]

    for kind, row in (("still", "nothing moved"), ("turned", "they are made"), ("shifted", "the built-in capture")):
        noticed = [f"{sum(c['noticed'] for c in group)} of {len(group)}" if group else "–" for group in of(kind)]
        says(f"{row} | {' | '.join(noticed)} |")
    for group, of_all in zip(
        of("still"), ("noticed is {} degrees and {} % of the distance in", "others {} and {} % in"), strict=True
    ):
        turns, shifts = ([each[f"least_{what}"] for each in group] for what in LEAST)
        says(of_all.format(part(median(turns), 2), part(median(shifts), 2)))
        says(f"the worst {part(max(turns), 2 if max(turns) < 1 else 1)} degrees and {max(shifts):.1f} %")
    usual = [
        quantiles([each[f"least_{what}"] for each in of("still")[0]], n=20, method="inclusive")[-1] for what in LEAST
    ]
    says(f"at most {part(usual[0], 2)} degrees and {part(usual[1], 2)} %")
    within = [[each["error_sigmas"] ** 2 < 12.59 for each in group] for group in of("pair")]
    says(f"in {sum(within[0])} of {len(within[0])} cases", f"others in {sum(within[1])} of {len(within[1])}")
    beyond = [each for each in checks if each["kind"] == "pair" and each["error_sigmas"] ** 2 >= 12.59]
    assert {each["scene"] for each in beyond} == {"hard_kitti_forward1"} and len(beyond) == 4
    says(f"up to {max(each['error_sigmas'] for each in beyond):.1f} standard deviations off")


def test_photographs_of_different_exposure():
    rows = raw("light")["rows"]
    for first in range(0, len(rows), 9):
        of_set, live = rows[first : first + 3], rows[first + 3 : first + 9]
        assert [row["kind"] for row in of_set] == ["one exposure", "gains", "gains, light off"]
        gains = of_set[1]
        scores = [" / ".join((f"{r['psnr']:.1f}", part(r["ssim"], 3), part(r["lpips"], 3))) for r in of_set]
        typical, largest = gains["gain_error_percent"]
        told = f"{gains['saturated_percent']:.0f} % | {part(typical, 1)}, {largest:.1f}"
        says(f"| {gains['scene']} | {gains['views']} | {' | '.join(scores)} | {told} |")
        assert [row["kind"] for row in live[2:4]] == ["gains, live, grown", "gains, live, in the end"]
        says(f"| {gains['scene']} | {gains['views']} | {' | '.join(_twice(live[i : i + 2]) for i in (0, 2, 4))} |")


def test_lenses_that_are_told():
    rows = raw("told_lenses")["rows"]
    assert {row["verdict"] for row in rows} == {"OK"}
    worse = dict.fromkeys(("rotation_error_deg", "centre_error_pct"), ())
    for first in range(0, len(rows), 5):
        straight, *bent = of_set = rows[first : first + 5]
        found = [f"{part(row['rotation_error_deg'], 2)}, {part(row['centre_error_pct'], 2)}" for row in of_set]
        says(f"| {straight['scene']} | {straight['views']} | {' | '.join(found)} |")
        for error in worse:
            worse[error] += tuple(row["scene"] for row in bent if row[error] > 1.5 * straight[error])
    assert list(worse.values()) == [("sceaux",), ("llff_fern",) * 3]
    says("Of 16 bent sets one turns a camera by more than 1.5 times", "and three, all of llff_fern, move one by more")


def test_cameras_that_tell_their_exposure():
    rows = raw("told_light")["rows"]
    assert all(row["left"] for row in rows)
    for first in range(0, len(rows), 5):
        of_set = rows[first : first + 5]
        assert [row["told"] for row in of_set] == ["nothing", "right", "steeper", "one wrong", "reversed"]
        errors = [row["gain_error_percent"] for row in of_set]
        told = " | ".join(f"{part(typical, 2)}, {largest:.1f}" for typical, largest in errors)
        says(f"| {of_set[0]['scene']} | {of_set[0]['views']} | {told} |")


def test_lenses_that_dim_their_corners():
    rows = raw("vignetting")["rows"]
    for on, off in zip(rows[::2], rows[1::2], strict=True):
        assert on["taken_out"] and not off["taken_out"] and off["found"] == 0
        found = f"{100 * on['found']:.0f} %" if on["found"] else "left"
        scores = [" / ".join((f"{r['psnr']:.1f}", part(r["ssim"], 3), part(r["lpips"], 3))) for r in (on, off)]
        says(f"| {on['scene']} | {on['views']} | {100 * on['loss']:.0f} % | {found} | {' | '.join(scores)} |")


def _twice(rows: list[dict]) -> str:
    return " → ".join(f"{row['psnr']:.1f}" for row in rows)


def test_lenses_that_bend_lines():
    rows = raw("bent")["rows"]
    taken_out = [row for row in rows if row["kind"] == "straight"]
    as_they_were = [row for row in rows if row["kind"] == "as photographed"]
    for row, other in zip(taken_out, as_they_were, strict=True):
        assert row["straightened"] and all(row[key] == other[key] for key in ("scene", "k1", "k2"))
        scores = [" / ".join((f"{r['psnr']:.1f}", part(r["ssim"], 3), part(r["lpips"], 3))) for r in (row, other)]
        true, found = ((row[f"{which}k1"], row[f"{which}k2"]) for which in ("", "estimated_"))
        lens = f"{coefficients(*true, 2)} | {coefficients(*found, 3)} | {-row['corner_shift_px']:.0f} px"
        says(f"| {row['scene']} | {lens} | {' | '.join(scores)} |")
    untouched = [row for row in rows if not row["k1"]]
    assert not any(row["straightened"] for row in untouched)
    (refused,) = (row for row in rows if row["estimated_k1"] is None)
    by = coefficients(refused["k1"], refused["k2"], 2)
    says(f"{refused['scene']} bent by {by} is refused (`{refused['verdict']}`)")
    (fern,) = (row for row in taken_out if (row["scene"], row["k1"], row["k2"]) == ("llff_fern", -0.25, 0))
    says(f"now {part(fern['rotation_error_deg'], 2)} degrees and {fern['focal_error_pct']:.1f} %")
    plain = [abs(row["corner_shift_px"]) for row in untouched]
    assert len(plain) == 7
    says(f"none moves by more than {max(plain) + 0.05:.1f} pixels")


def coefficients(k1: float, k2: float, digits: int) -> str:
    return f"{change(k1, digits)}, {change(k2, digits) if k2 else 0}"


def test_lenses_of_which_nothing_is_known():
    rows = raw("unknown_lenses")["rows"]
    radial = [row for row in rows if not row["lens"].startswith("fisheye")]
    assert all(row["published"] and row["verdict"] == "OK" for row in radial)
    for name in dict.fromkeys(row["lens"] for row in rows if row["corner_moves_pct"]):
        of = [row for row in rows if row["lens"] == name]
        moved = f"{of[0]['corner_moves_pct']:.0f} %"
        verdicts = ", ".join(dict.fromkeys(row["verdict"] for row in of))
        errors = [max(row[key] for row in of) for key in ("corner_error_px", "rotation_error_deg", "centre_error_pct")]
        words = (
            name.replace("-", "−")
            .replace("+0.", "+.")
            .replace("−0.", "−.")
            .replace("k2 +0", "k2 0")
            .replace("k1 +0, k2 0", "none")
        )
        shown = f"{errors[0]:.1f} px | {part(errors[1], 3)}° | {part(errors[2], 3)} %"
        says(f"| {words} | {moved} | {verdicts} | {shown} |")
    says(
        f"at most {part(max(row['corner_error_px'] for row in radial), 1)} pixels of 1024",
        f"move a corner by up to {max(row['corner_moves_pct'] for row in radial):.0f} % of its distance",
    )
    wide = [row for row in rows if row["corner_moves_pct"] is None]
    assert len(wide) == 2 and not any(row["published"] for row in wide)


def test_speed_of_parts():
    clock = raw("rasterize")["cases"]["50k_512x384_all"]["clock_ms"]
    says(f"| {clock['median']:.1f} ms in the median, {clock['min']:.1f} ms at best | `rasterize.json` |")
    pair = raw("priors")["figures"]["mast3r"]
    says(f"| {pair['seconds_pair']:.0f} s, {pair['peak_rss_mb'] / 1e3:.1f} GB | `priors.json` |")


def listed() -> dict[str, str]:
    """The commit that the page gives, by raw file."""
    text = (ROOT / MEASUREMENT).read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([0-9a-f]{7,}) \| ((?:`\w+\.json`(?:, )?)+) \|$", text, re.MULTILINE)
    return {name: commit for commit, names in rows for name in re.findall(r"`(\w+\.json)`", names)}


def test_every_raw_file_is_listed():
    assert set(listed()) == {path.name for path in RESULTS.glob("*.json")}


@pytest.mark.parametrize("name", sorted(listed()))
def test_a_raw_file_is_that_of_the_commit_that_the_page_gives(name):
    def git(*arguments: str) -> int:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, check=False).returncode

    if git("cat-file", "-e", f"{listed()[name]}^{{commit}}"):
        pytest.skip("needs the project's whole history in git")
    assert git("diff", "--quiet", listed()[name], "--", f"tests/bench/results/{name}") == 0


def test_the_table_of_the_readme():
    windows = {method: found["all"] for method, found in raw("windows")["summary"].items()}
    right = {method: found["right"] + found["right_part"] for method, found in windows.items()}
    ours = windows["splatnode"]
    scenes = len({row["scene"] for row in raw("windows")["rows"]})
    bounds = raw("fit")["many"]["cross_validated"]["windows"]
    stability = raw("stability")
    trials = [trial for trial in stability["trials"] if trial["method"] == "splatnode"]
    kinds, seeds = len({trial["name"] for trial in trials}), len({trial["seed"] for trial in trials})
    splatnode, instantsplat = (
        (
            over_sets(rows, lambda row: row["psnr"]),
            thousands(over_sets(rows, lambda row: row["num_gaussians"])),
            over_sets(rows, lambda row: row["seconds"]["total"]),
        )
        for rows in (ends("bench_7sets", method=method) for method in ("balanced", "instantsplat-xl"))
    )
    walk = raw("building_1000_judged")
    within = walk["cameras"]["position_percent_of_path"]
    says(
        f"| {ours['sets']} windows of 3, 6 and 12 photographs from {scenes} real scenes: cameras right "
        f"| {right['splatnode']}, of these {ours['right_part']} in part "
        f"| COLMAP {right['colmap']}, GLOMAP {right['glomap']} |",
        f"| the same windows: published with wrong cameras | {ours['wrong']} "
        f"| COLMAP {windows['colmap']['wrong']}, GLOMAP {windows['glomap']['wrong']} |",
        f"| {100 * bounds['rotations_within']:.0f} % of the rotations, "
        f"{100 * bounds['centres_within']:.0f} % of the positions |",
        f"| photographs mistreated in {kinds} ways, {seeds} times each: published beyond its claim "
        f"| {stability['methods'][0]['false_accept']['count']} of {len(trials)} |",
        f"| {splatnode[0]:.1f} dB, {splatnode[1]} Gaussians, {splatnode[2]:.0f} s on one core "
        f"| InstantSplat-XL\\* {instantsplat[0]:.1f} dB, {instantsplat[1]} Gaussians, {instantsplat[2]:.0f} s |",
        f"| a walk of {walk['keyframes']} keyframes through a made-up building "
        f"| {walk['in_a_scene']} placed, in one map, within {within:.4f} % of the way; "
        f"{walk['loops']['loop_links']} loops, none wrong |",
        on=README,
    )


def test_consistent_depth():
    every = list(raw("consistent_depth")["rows"].values())
    found = [row for row in every if row["consistent_depth"] is not None]
    pairs = sum(len(row["photographs"]) == 2 for row in every)
    says(f"{len(every)} small sets of photographs, {len(every) - pairs} of three to twelve views and {pairs} pairs")
    shares = [100 * row["consistent_depth"] for row in found]
    says(f"{len(found)} were published; their share is {min(shares):.0f} to {max(shares):.0f} %")
    limit = npz_files.ConsistentDepthConfig().min_share
    for words, kept in (
        ("below 45 %", [row for row in found if row["consistent_depth"] < limit]),
        ("45 % and more", [row for row in found if row["consistent_depth"] >= limit]),
    ):
        quality, poor = [row["psnr"] for row in kept], [view["psnr"] < 20 for row in kept for view in row["held_out"]]
        says(
            f"| {words} | {len(kept)} | {np.mean(quality):.1f} dB, {min(quality):.1f} to {max(quality):.1f} "
            f"| {part(float(np.mean([row['ssim'] for row in kept])), 3)} | {100 * np.mean(poor):.0f} % |"
        )
    correlation, _ = spearmanr([row["consistent_depth"] for row in found], [row["psnr"] for row in found])
    says(f"The rank correlation of share and PSNR is {part(float(np.asarray(correlation)), 2)}")


def test_needles():
    covered = {(row["scene"], row["label"]): row["covered_pct"] for row in raw("needles")["rows"]}
    rows = []
    for scene in dict.fromkeys(scene for scene, _ in covered):
        values = (covered.get((scene, label)) for label in ("main", "only-seen"))
        rows.append(f"| {scene} | " + " | ".join("–" if value is None else part(value, 2) for value in values) + " |")
    says(*rows, on="docs/clean_scenes.md")


def test_all_rows_of_a_case_of_the_race_start_from_the_same_cameras():
    assert race_page.unlike() == []


def test_the_race():
    lines = race_page.lines()
    assert len(lines) >= 14
    says(*lines, *race_page.against(), race_page.summary(), race_page.thorough())
    says(race_page.seeds(), race_page.certain(), race_page.quick())
    says(*race_page.headlines(), on="README.md")


def test_things_that_move():
    found = {(row["scene"], row["share"], row["kind"]): row for row in raw("movers")["results"]}
    kinds = ("without", "masks", "found")
    cases = dict.fromkeys((scene, share) for scene, share, _ in found)
    assert len(found) == len(kinds) * len(cases) == 27
    for scene, share in cases:
        rows = [found[scene, share, kind] for kind in kinds]
        whole = [row["verdict"] if row["psnr"] is None else f"{row['psnr']:.1f}" for row in rows]
        shown = ["–" if row["psnr_two"] is None else f"{row['psnr_two']:.1f}" for row in rows]
        says(f"| {scene} | {share:.0%} | {' | '.join((*whole, *shown))} |")
    fountain, fern, fox = (f"{found[scene, 0.3, 'without']['two_pct']:.0f}" for scene in dict(cases.keys()))
    assert fountain == fern
    says(f"where 30 % are covered, {fern} % of all, of fox {fox} %")


def test_fisheyes():
    found = {(row["across_deg"], row["views"], row["lens"]): row for row in raw("fisheyes")["results"]}
    cases = [(across, views) for across, views, lens in found if lens == "fisheye"]
    assert len(cases) == 4
    for across, views in cases:
        row, other = (found[across, views, lens] for lens in ("fisheye", "pinhole"))
        errors = f"{row['rotation_error_deg']:.3f} | {row['centre_error_pct']:.3f}"
        psnr = f"{row['psnr']:.1f} | {other['psnr']:.1f}"
        says(f"| {across:.0f} degrees | {views} | {row['verdict']} | {errors} | {psnr} |")


def test_a_cluster_that_loses_a_worker_and_a_node():
    row = raw("batch_ray")
    simulated, real = row["simulated"], row["real"]
    for each in (simulated, real):
        assert each["ledger_lines"] == each["recordings"] and each["hidden_files_left"] == each["other_folders"] == 0
    assert simulated["rows"] == simulated["as_expected"] == simulated["recordings"]
    lost = simulated["worker_killed_at_row"], simulated["node_removed_at_row"]
    whole, count = simulated["results_whole"], simulated["recordings"]
    says(
        f"a batch of {count} simulated recordings on two node processes of Ray on one machine; a worker killed with -9 "
        f"at row {lost[0]}, a node removed at row {lost[1]}",
        f"{count} of {count} have their one answer, {simulated['repeated']} repeated, {whole} of {whole} results whole",
        f"a worker killed at row {real['worker_killed_at_row']}, a node removed at row {real['node_removed_at_row']}",
    )
    some, of_each, same = real["recordings"], (real["windows"], real["built_in"]), real["the_same_to_the_bit"]
    assert real["rows"] == real["results_whole"] == some == sum(of_each) == real["compared_with_replay_alone"]
    assert same == some and not real["others"]
    says(
        f"{some} real recordings in the same way ({of_each[0]} windows of three photographs of the real scenes, "
        f"{of_each[1]} built-in captures",
        f"{some} of {some} results whole, each once, nothing half is left; {real['with_a_scene']} have a scene",
        f"of {some} that were replayed alone, too, {same} are the same to the bit",
    )
    says(
        f"{some} real recordings, {of_each[0]} windows of three photographs and {of_each[1]} built-in captures",
        f"{some} of {some} have their one result, {real['with_a_scene']} of them a scene",
        f"{some} were replayed alone, too: {same} of {some} are the same to the bit",
        on="docs/cluster.md",
    )
    says(
        f"{count} simulated recordings, of which a worker was killed with -9 and a node removed",
        f"{simulated['repeated']} began twice",
        on="docs/cluster.md",
    )


def test_calibration():
    found = raw("calibrate")["results"]
    lenses = list(dict.fromkeys(row["lens"] for row in found))
    assert len(lenses) == 5 and not any(row["missing"] for row in found)
    for lens in lenses:
        rows = [row for row in found if row["lens"] == lens]
        (model,) = {row["model"] for row in rows}
        focal, corner = (max(row[error] for row in rows) for error in ("focal_error_pct", "corner_error_px"))
        told = median(row["corner_sigma_px"] for row in rows)
        assert len(rows) == 4 and focal < 0.2 and corner < 0.3
        says(f"| {lens} | `{model}` | {focal:.3f} | {part(corner, 2)} | {part(told, 2)} |")
    held = sum(row["corner_error_px"] <= 2 * row["corner_sigma_px"] for row in found)
    says(f"within twice the standard deviation that is told in {held} of {len(found)}")


def test_the_throughput_of_a_batch():
    row = raw("throughput")
    assert row["processors"] == 2
    says(
        f"a batch of {row['recordings']} real recordings (built-in capture, preset `{row['preset']}`), two at a time",
        f"{row['times_one_core']:.2f} times as many an hour as one at a time",
    )


def test_a_gpu():
    found = raw("gpu")
    figures, times = {each["name"]: each for each in found["figures"]}, found["times"]
    assert all(abs(each["value"]) <= each["bound"] for each in figures.values())
    pixels = [each["value"] for name, each in figures.items() if name.endswith("a pixel")]
    gradients = [each["value"] for name, each in figures.items() if "gradient" in name]
    assert max(pixels) <= 6e-6 and max(gradients) <= 2e-6
    assert abs(figures["built-in capture: held-out PSNR, dB"]["value"]) <= 0.02
    whole = [ms for name, ms in times.items() if name.endswith("_all, ms an iteration")]
    of = "built-in capture, balanced, 52498 Gaussians at first, on {}, ms an iteration"
    says(
        f"an {found['machine']['gpu']} and {found['machine']['cores']} cores",
        "pixels within 6e-6, gradients within 2e-6 of their length",
        f"takes {min(whole):.1f} to {max(whole):.1f} ms with depths and normals",
        f"takes {times[of.format('cuda')]:.1f} ms, and {times[of.format('cpu')]:.1f} ms on the 16 cores",
    )


def test_runs_on_a_gpu():
    found = raw("bench_gpu")
    for device, words in (("cuda", "H200"), ("cpu", "16 cores")):
        for row in found[device]["rows"]:
            method = "InstantSplat-XL" if row["method"] == "instantsplat-xl" else f"`{row['method']}`"
            seconds = f"{row['seconds']['optimise']:.1f} s | {row['seconds']['total']:.1f} s"
            says(f"| {row['scene']} | {method} | {words} | {row['psnr']:.1f} dB | {seconds} |")


def test_the_trials_of_a_core_hour():
    row = raw("campaign")
    count, in_an_hour = row["trials"], row["trials_in_a_core_hour"]
    assert sum(row["outcomes"].values()) == count and "failed" not in row["outcomes"]
    seeds, rest = divmod(count, row["kinds"])
    assert rest == 0 and round(3600 * count / row["processor_seconds"], -1) == round(in_an_hour, -1)
    assert 0.45 < row["outcomes"]["accepted"] / count < 0.6  # one in two
    says(
        "short trials of the stability matrix, one at a time on one core, busy machine: "
        f"{row['kinds']} kinds with {seeds} seeds, of which one in two gets a scene",
        f"{count} trials in one command: {in_an_hour} in an hour of processor time",
        f"of which {100 * row['reconstructing_seconds'] / row['processor_seconds']:.0f} % reconstruct",
    )
    says(f"| {in_an_hour}: 10 000 take {10_000 / in_an_hour:.1f} core-hours |", on="docs/cluster.md")


def test_a_simulated_batch():
    row = raw("batch_simulation")
    last, count = row["last_life"], f"{row['recordings']:,}".replace(",", " ")
    assert row["rows"] == row["as_expected"] == row["recordings"] == 10_000 and row["hidden_files_left"] == 0
    assert row["results_whole"] == row["rows"] - row["verdicts"]["FAILED"]
    memory = last["memory_mb_after_a_tenth"], last["memory_mb_at_the_last_recording"]
    says(
        f"a batch of {count} simulated recordings, its driver killed with -9 {row['kills_of_the_driver']} times",
        f"{row['repeated']} were repeated ({row['repeated_percent']:.2f} %); the driver's memory {memory[0]:.1f} MB "
        f"after a tenth, {memory[1]:.1f} MB at the end",
    )
    assert memory[1] < 1.05 * memory[0] and row["repeated_percent"] < 1
    says(
        f"In a simulation of {count} recordings whose batch was killed {row['kills_of_the_driver']} times, "
        f"{row['repeated']} were repeated, and the process that starts them took {memory[0]:.0f} MB "
        f"after a tenth and {memory[1]:.0f} MB at the end",
        on="docs/batch.md",
    )


def test_faults_that_the_tests_find():
    mutants = raw("mutants")["mutants"]
    for room in {each["room"] for each in mutants}:
        own = [each for each in mutants if each["room"] == room]
        says(f"| {room} | {len(own)} | {sum(each['killed'] for each in own)} |")
    killed = sum(each["killed"] for each in mutants)
    says(f"{killed} of {len(mutants)}", *(f"\u201c{each['name']}\u201d" for each in mutants if not each["killed"]))


def test_what_a_thousand_recordings_take():
    own = [row["seconds"]["total"] for row in ends("bench_7sets", method="balanced")]
    seconds = round(mean(own))
    hours = 1000 * seconds / 3600
    says(
        f"| {seconds} s |",
        f"3600 / {seconds} = {int(3600 / seconds)} recordings",
        f"1000 × {seconds} / 3600 = {hours:.1f} core-hours",
        on="docs/batch.md",
    )
    most_mb = max(row["peak_rss_mb"] for row in raw("replay")["rows"])
    says(f"`fast` and `balanced`) | {most_mb / 1000:.1f} GB", on="docs/batch.md")
