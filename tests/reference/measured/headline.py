"""README.md: the strongest figures that hold, what is lost first; each scene judged by numbers fitted without it."""

from __future__ import annotations

from collections.abc import Callable

from tests.reference.measured import race
from tests.reference.measured.raw import ends, percent, raw, require, table, thousands
from tests.reference.measured.scenes import average_recipe


def headline() -> str:
    """The table of README.md."""
    return table(
        ("measured", "splatnode", "others"),
        [*_damaged(), *_windows(), *_bounds(), *race.headlines(), *_presets(), *_walk()],
    )


def _damaged() -> list[tuple[str, str, str]]:
    names = ("lens_assumptions", "lens_assumptions_draws", "lens_assumptions_later")
    judged = [each for name in names for each in raw(f"{name}_judged")["trials"]]
    trials = [each for each in judged if each["kind"] != "clean"]
    matrix = raw("fit")["many"]["cross_validated"]["matrix"]
    return [
        (
            f"{len(trials)} sets made to break what is assumed of a lens: published, of these wrong",
            f"{sum(each['published'] for each in trials)}, {sum(each['wrong'] for each in trials)}",
            "–",
        ),
        (
            f"{matrix['sets']} sets damaged in other ways: published, of these wrong",
            f"{matrix['published']}, {matrix['beyond']}",
            "–",
        ),
    ]


def _windows() -> list[tuple[str, str, str]]:
    unseen, windows = raw("unseen")["windows"], {name: each["all"] for name, each in raw("windows")["summary"].items()}
    counts = {name: (each["right"], each["wrong"]) for name, each in unseen["methods"].items()}
    few = [each for name, each in counts.items() if "few views" in name]
    scenes = len({row["scene"] for row in raw("windows")["rows"]})
    right = {name: f"{each['right'] + each['right_part']}, {each['wrong']}" for name, each in windows.items()}
    own = [row for row in raw("windows")["rows"] if row["method"] == "splatnode" and row["published"]]
    rough = sum(row["verdict"] == "OK_ROUGH" for row in own)
    return [
        (
            f"{unseen['sets']} windows of 3, 6 and 12 images from six scenes that development never had: right, wrong",
            "{}, {}".format(*counts["splatnode"]),
            f"COLMAP {few[0][0]}, {few[0][1]} and {few[1][0]}, {few[1][1]} with options for few views, "
            "{}, {} by default; ".format(*counts["COLMAP, default options"])
            + "GLOMAP {}, {}".format(*counts["GLOMAP, default options"]),
        ),
        (
            f"{windows['splatnode']['sets']} windows from the {scenes} scenes of development",
            f"{right['splatnode']}; {rough} of the {len(own)} published are called rough",
            f"COLMAP {right['colmap-few-views']} and GLOMAP {right['glomap-few-views']} with options for few views, "
            f"{right['colmap']} and {right['glomap']} by default",
        ),
    ]


def _bounds() -> list[tuple[str, str, str]]:
    held = raw("fit")["many"]["cross_validated"]["windows"]
    return [
        (
            "their 95 % bounds hold for",
            f"{percent(held['rotations_within'])} of the rotations, {percent(held['centres_within'])} of the "
            f"positions, {percent(held['focals_within'])} of the focal lengths",
            "no bounds",
        )
    ]


def _presets() -> list[tuple[str, str, str]]:
    ours, theirs = (
        f"{means['psnr']:.1f} dB, {thousands(means['num_gaussians'])} Gaussians, {means['seconds']:.0f} s"
        for means in (average_recipe(ends("bench_7sets", method=method)) for method in ("balanced", "instantsplat-xl"))
    )
    return [
        (
            "held-out PSNR, mean of the seven sets that presets were chosen on, one core",
            ours,
            f"InstantSplat-XL\\* {theirs}",
        )
    ]


def _walk() -> list[tuple[str, str, str]]:
    walk, again = raw("building_1000"), raw("building_1000_judged")
    loops = again["loops"]
    require(not loops["wrong_loop_links"] and again["maps"] == 1, "one map, no wrong loop")
    own, later = (each["cameras"]["position_percent_of_path"] for each in (walk, again))
    return [
        (
            f"a walk of {walk['keyframes']} keyframes through a rendered building",
            f"{again['in_a_scene']} placed in one map, within {own:.3f} % of the way; after a restart with newer "
            f"code {later:.4f} % and {loops['loop_links']} loops, none wrong; {loops['retracted']} wrong ones were "
            "retracted",
            "–",
        )
    ]


BLOCKS: tuple[Callable[[], str], ...] = (headline,)
