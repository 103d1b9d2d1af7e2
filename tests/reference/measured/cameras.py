"""docs/camera_accuracy.md: cameras, their bounds, lenses, query images, and cameras that moved."""

from __future__ import annotations

from collections.abc import Callable
from statistics import mean, median, quantiles
from typing import Any

import numpy as np

from tests.reference.measured.raw import bullets, change, part, percent, raw, require, scores, span, table

QUERIES = {
    "zoomed 1.02 to 1.3 times": [f"zoom {factor}" for factor in (1.02, 1.05, 1.1, 1.2, 1.3)],
    "zoomed 1.6, 2 times": ["zoom 1.6", "zoom 2.0"],
    "zoomed 2.5, 3 times": ["zoom 2.5", "zoom 3.0"],
    "cropped to 80 %": ["cut middle 0.8", "cut corner 0.8", "crop corner 0.8"],
    "mirrored": ["mirror"],
    "black borders, at 75 %": ["letterbox 0.75"],
    "stretched by 1.1, squeezed to 75 %": ["stretch 1.1", "squeeze 0.75"],
    "bent by k1 −.15, .1": ["bend -0.15", "bend 0.1"],
    "sheared by 1, 2, 4 %, as by a rolling shutter": ["shear 0.01", "shear -0.02", "shear 0.04"],
    "motion blur, 2 % of the width": ["blur 0.02"],
    "collage: halves changed places": ["collage"],
    "unchanged; without, with EXIF, with the lens": ["clean", "clean exif", "clean given"],
    "zoomed 1.1 to 2 times, EXIF or lens of the whole": [
        f"zoom {factor} {told}" for factor in (1.1, 1.3, 2.0) for told in ("exif", "given")
    ],
}  # fmt: skip
LEAST = "turn_deg", "shift_percent"  # moves that an audit would have noticed
WITHIN_95 = 12.59  # of chi-squared with six degrees of freedom


def windows() -> str:
    """Windows of consecutive photographs: what each method makes of them."""
    counts = "right", "right_part", "between", "wrong", "refused"
    rows = [
        (title, *(raw(name)["summary"][method]["all"][kind] for kind in counts))
        for title, name, method in (
            ("splatnode", "windows", "splatnode"),
            ("COLMAP, default options", "windows", "colmap"),
            ("COLMAP, options for few views", "windows", "colmap-few-views"),
            ("GLOMAP, default options", "windows", "glomap"),
            ("GLOMAP, options for few views", "windows", "glomap-few-views"),
            (
                "splatnode, older code, numbers fitted to these windows (`windows_again.json`)",
                "windows_again",
                "splatnode",
            ),
        )
    ]
    total, scenes = raw("windows")["summary"]["splatnode"]["all"]["sets"], {r["scene"] for r in raw("windows")["rows"]}
    header = (f"of {total} windows from {len(scenes)} scenes", "right", "right in part", "less exact", "wrong", "none")
    beside = [_compare_by_place(words, method) for words, method in BETTER_ROWS]
    return f"{table(header, rows)}\n\n{bullets(*beside)}"


BETTER_ROWS = ("COLMAP's", "colmap-few-views"), ("GLOMAP's", "glomap-few-views")


def _compare_by_place(words: str, method: str) -> str:
    """Right and wrong windows of splatnode beside a method's, with intervals by resampling places, at a fixed seed."""
    found: dict[str, dict[str, list[str]]] = {}
    for row in raw("windows")["rows"]:
        found.setdefault(row["scene"], {}).setdefault(row["method"], []).append(row["found"])
    ours, theirs = ([each[name] for each in found.values()] for name in ("splatnode", method))
    require(all(len(a) == len(b) for a, b in zip(ours, theirs, strict=True)), "the same windows of each place")
    right = [
        np.array([sum(each in ("right", "right_part") for each in place) for place in many]) for many in (ours, theirs)
    ]
    wrong = [np.array([place.count("wrong") for place in many]) for many in (ours, theirs)]
    lead = right[0] - right[1]
    draws = np.random.default_rng(0).integers(len(lead), size=(20000, len(lead)))
    low, high = (round(float(np.quantile(lead[draws].sum(1), q))) for q in (0.025, 0.975))
    fewest, most = (round(float(np.quantile(wrong[1][draws].sum(1), q))) for q in (0.025, 0.975))
    return (
        f"Beside {words} row for few views: {lead.sum():+d} right, by resampled places {low:+d} to {high:+d} (95 %), "
        f"ahead at {(lead > 0).sum()} of {len(lead)} places, behind at {(lead < 0).sum()}; {wrong[0].sum()} wrong "
        f"beside {wrong[1].sum()} ({fewest} to {most})."
    )


def bounds() -> str:
    """How often bounds hold and right sets are published; each scene by numbers that were fitted without it."""
    many, pairs = (raw("fit")[kind]["cross_validated"] for kind in ("many", "pair"))
    told, pair = many["windows_told"], pairs["windows"]
    rows = []
    for words, each in (
        ("3 or more views", many["windows"]),
        *((f"{count} views", many["windows_by_count"][count]) for count in ("3", "6", "12")),
        ("3 or more, EXIF within 3 % or the lens given", told),
        ("pairs", pair),
    ):
        shares = (percent(each[f"{what}_within"]) for what in ("rotations", "centres", "focals"))
        rows.append((words, f"{each['right_published']} of {each['right']}", each["beyond"], *shares))
    header = ("sets", "right sets published", "beyond the claim", "rotations", "centres", "focal lengths")
    scenes = [*many["windows_by_scene"].items()]
    least = []
    for what, words in (("rotations", "rotations"), ("centres", "centres"), ("focals", "focal lengths")):
        name, found = min(scenes, key=lambda item: item[1][f"{what}_within"])
        least.append(f"{percent(found[f'{what}_within'])} of the {words} ({name})")
    return f"{table(header, rows)}\n\n{bullets('Worst scene: ' + ', '.join(least) + '.')}"


def lens_assumptions() -> str:
    """Images that share no lens: published, wrong, and what is left of sets whose unchanged images are answered."""
    trials = raw("lens_assumptions_judged")["trials"]
    clean = {_key(t) for t in trials if t["kind"] == "clean" and t["published"] and not t["wrong"]}
    changed = [t for t in trials if t["kind"] != "clean"]
    require({t["kind"] for t in changed} == {kind for kinds in KINDS.values() for kind in kinds}, "kinds of changes")
    groups: list[tuple[str, Callable[[dict[str, Any]], bool]]] = [
        (words, lambda t, kinds=kinds: t["kind"] in kinds) for words, kinds in KINDS.items()
    ]
    groups += [
        (f"all, {words}", lambda t, setting=setting: t["setting"] == setting)
        for setting, words in (("nothing", "no lens told"), ("exif", "EXIF"), ("given", "lens given"))
    ]
    groups += [(f"all, {count} images", lambda t, count=count: t["count"] == count) for count in (3, 6, 12)]
    groups.append(("all", lambda t: True))
    rows = [_lens_row(words, [t for t in changed if chosen(t)], clean) for words, chosen in groups]
    rows.append(_lens_row("unchanged", [t for t in trials if t["kind"] == "clean"], clean))
    for name, what in (("draws", "drawn afterwards, 3 images"), ("later", "kinds made afterwards, 3 and 6 images")):
        later = raw(f"lens_assumptions_{name}_judged")["trials"]
        same = {_key(t) for t in later if t["kind"] == "clean" and t["published"] and not t["wrong"]}
        for setting, words in (("nothing", "no lens told"), ("exif", "EXIF"), ("given", "lens given")):
            drawn = [t for t in later if t["kind"] != "clean" and t["setting"] == setting]
            rows.append(_lens_row(f"{what}, {words}", drawn, same))
        require(len({t["scene"] for t in trials}) == len({t["scene"] for t in later}) == 11, "eleven scenes")
    return table(("images", "sets", "published", "wrong", "right, of those right unchanged"), rows)


def _key(trial: dict[str, Any]) -> tuple[str, int, str, int]:
    return trial["scene"], trial["count"], trial["setting"], trial.get("draw", 0)


def _lens_row(words: str, trials: list[dict[str, Any]], clean: set[tuple[str, int, str, int]]) -> tuple[object, ...]:
    compared = [t for t in trials if _key(t) in clean]
    good = sum(t["published"] and not t["wrong"] for t in compared)
    published, wrong = (sum(t[key] for t in trials) for key in ("published", "wrong"))
    return words, len(trials), published, wrong, f"{good} of {len(compared)}"


KINDS = {
    "zoomed up to 1.1 times": ("one zoomed 1.05", "one zoomed 1.1"),
    "one zoomed 1.3, 2 times": ("one zoomed 1.3", "one zoomed 2"),
    "two or three cameras, focal lengths up to 1.25 apart": (
        "cameras 1 : 1.02", "cameras 1 : 1.06", "cameras 1 : 1.12", "cameras 1 : 1.1 : 1.25",
    ),
    "two cameras, 1.5 apart": ("cameras 1 : 1.5",),
    "breathing focus, 1 and 2 %": ("breathing 1 %", "breathing 2 %"),
    "a film that zooms": ("zooming film",),
    "letterbox": ("letterbox",),
    "off-centre crops, one or all": ("one off-centre crop", "all off-centre crops"),
    "keystone, one or all": ("one keystone", "all keystone"),
    "one distorted; stabilised": ("one distorted", "stabilised"),
    "pixels not square; false fx or principal point": ("pixels not square", "wrong fx", "wrong principal point"),
}  # fmt: skip


def several_cameras() -> str:
    """Several different cameras on one place, lenses told, half told, or not."""
    trials = raw("several_cameras")["trials"]
    one = {_key(t) for t in trials if t["mix"] == "one" and t["published"] and not t["wrong"]}
    rows = []
    for setting, words in (("told", "all lenses given"), ("half", "one lens given"), ("nothing", "none given")):
        group = [t for t in trials if t["mix"] != "one" and t["setting"] == setting]
        rows.append(_lens_row(words, group, one))
    scenes = len({t["scene"] for t in trials})
    header = (f"6 images, {scenes} scenes", "sets", "published", "wrong", "right, of those right with one camera")
    return table(header, rows)


def rigs() -> str:
    """Mounts of three cameras on a rig: the largest error of two, and the largest share of a bound."""
    rows = []
    for method, words in (
        ("estimated", "the frame sets alone"),
        ("given", "given, .5 cm and .5°"),
        ("colmap", "COLMAP"),
    ):
        group = [row for row in raw("rigs")["rows"] if row["method"] == method]
        shares = [row[of] / row[bound] for row in group if row["bound_deg"] is not None
                  for of, bound in (("degrees", "bound_deg"), ("percent", "bound_percent"))]  # fmt: skip
        degrees, percent = (max(row[of] for row in group) for of in ("degrees", "percent"))
        rows.append((words, f"{degrees:.3f}", f"{percent:.3f}", f"{max(shares):.2f}" if shares else "–"))
    return table(("rig", "degrees", "% of the distance", "largest error over its bound"), rows)


def rgbd() -> str:
    """Depth images: what is found of the surface, and how depth cameras are judged."""
    surface, cameras = (raw("rgbd")["summary"][name] for name in ("surface", "depth_cameras"))
    rows = [
        (words.replace(" pixels", "").replace("depth", "depth images", 1), each["places"], each["answered"],
         percent(each["found"], 1), percent(each["median_error"], 2))
        for words, each in surface.items()
    ]  # fmt: skip
    header = "width in pixels, place, depth", "places", "answered", "surface found to 2 %", "median error of depth"
    words = {
        "good": "a good one",
        "noisy": "noise twice as large as it says",
        "shifted": "4 pixels (of 640) aside",
        "aside": "stands 2 cm aside, not told",
        "aside, told": "stands 2 cm aside, told",
        "3 % too large": "depths 3 % too large",
    }
    judged = [
        (words[kind], each["cameras"], each["named_shifted"], each["named_otherwise"],
         each["named_scale_beside_marker"], _format_error(each["largest_unit_error"]), each["beyond_bound"])
        for kind, each in cameras.items()
    ]  # fmt: skip
    told = "depth camera", "trials", "named as shifted", "named otherwise", "scale named beside a marker"
    return f"{table(header, rows)}\n\n{table((*told, 'largest error of metres', 'beyond bound'), judged)}"


def _format_error(share: float | None) -> str:
    return "–" if share is None else percent(share, 2)


def rgbd_real() -> str:
    """Depth of other photographs' stereo in place of a depth camera, in recorded scenes."""
    rows = [
        (each["case"].replace(":", ", "), percent(each["known"]), percent(each["found_alone"], 1),
         percent(each["found"], 1), each["cameras"], each["good_named"], each["shifted_named"], each["scale_named"])
        for each in raw("rgbd_real")["rows"] if each["found"] is not None
    ]  # fmt: skip
    found = "scene, photographs", "pixels whose depth is known", "of it found alone", "with depth images"
    return table((*found, "depth cameras of each kind", "good named", "shifted named", "scale named"), rows)


def odometry_walk() -> str:
    """A walk with odometry and depth images, in the odometry's frame."""
    rows = [
        (each["keyframes"], each["placed"], f"{each['way_m']:.0f} m", _format_percent(each["worst_percent"]),
         _format_percent(each["median_percent"]), _format_percent(each["odometry_percent"]),
         "–" if each["up_deg"] is None else f"{each['up_deg']:.2f}°")
        for each in raw("odometry_walk")["rows"]
    ]  # fmt: skip
    off = "worst position, of the way", "median", "odometry alone, worst", "up off by"
    return table(("keyframes", "placed", "way", *off), rows)


def _format_percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f} %"


def plain_rooms() -> str:
    """Rooms with plain walls, whose cameras depth images place."""
    words = {
        "good": "as it says",
        "noisy": "noise twice as large as it says",
        "shifted": "depth 4 pixels (of 640) aside",
        "lens": "a focal length that is told 10 % too long",
    }
    rows = []
    for kind, each in raw("plain_rooms")["summary"].items():
        answered, error = each["answered_with_depth"], each["largest_unit_error"]
        counts = each["refused_alone"], answered, each["cameras_placed"], each["wrong"], each["beyond_bound"]
        told = (
            "–" if error is None else percent(error, 1),
            "–" if each["median_seconds"] is None else f"{each['median_seconds']:.0f}",
        )
        rows.append((words[kind], each["rooms"], *counts, *told))
    header = (
        "depth camera",
        "rooms",
        "refused alone",
        "answered with depth",
        "cameras placed",
        "rooms with a wrong camera",
        "rooms with any beyond its bound",
        "largest error of metres",
        "seconds of the processor",
    )
    return table(header, rows)


def plain_view() -> str:
    """Rooms of which one photograph shows plain walls."""
    told = raw("plain_view")["summary"]
    header = "rooms", "others placed", "plain view placed, too", "rooms with a wrong camera"
    off = "largest error of a position", "largest error over bound"
    centre, over = told["largest_centre_m"], told["largest_over_bound"]
    row = told["rooms"], told["five_or_more"], told["plain_views_placed"], told["wrong"]
    return table((*header, *off), [(*row, "–" if centre is None else f"{1000 * centre:.0f} mm", f"{over:.2f}")])


def known_poses() -> str:
    """Poses that are given, with one of them false or none."""
    found, rows = raw("known_poses")["rows"], []
    for kind, words in (("clean", "none"), ("turn", "turned by 3°"), ("shift", "shifted by 3 % of the distance")):
        group = [row for row in found if row["kind"] == kind]
        matched = [row for row in group if row["matches"]]
        named = f"{sum(row['named_right'] for row in matched)} of {len(matched)}"
        strangers = sum(row["named"] - (row["named_right"] is True) for row in group)
        beyond = sum(max(row["centre_over_bound"], row["rotation_over_bound"]) > 1 for row in group)
        most = max(max(row["centre_over_bound"], row["rotation_over_bound"]) for row in group)
        told = ("–", "–") if kind == "clean" else (named, len(group) - len(matched))
        rows.append((words, len(group), *told, strangers, beyond, f"{most:.1f}"))
    header = (
        "false pose",
        "runs",
        "it is named, where it has matches",
        "it has no match",
        "others named",
        "any camera beyond a bound",
        "largest error over bound",
    )
    return table(header, rows)


GIVEN_OURS = "balanced", "fast"
GIVEN_RIVALS = {"mcmc+fill": "MCMC", "3dgs": "3DGS", "fsgs": "FSGS"}


def given_scenes() -> str:
    """Scenes of poses that are given, beside other recipes from the same cameras and points."""
    found = raw("given_scenes")
    sets: dict[str, dict[str, dict[str, Any]]] = {}
    for row in found["rows"]:
        sets.setdefault(f"{row['scene']}, {row['views']}", {})[row["method"]] = row
    sets = {name: rows for name, rows in sets.items() if {*GIVEN_OURS} < rows.keys()}
    require(all(rows[ours]["psnr"] for rows in sets.values() for ours in GIVEN_OURS), "both presets make each scene")
    without = [
        f"{GIVEN_RIVALS[method]} of {name} ({row['why']})"
        for name, rows in sets.items() for method, row in rows.items() if row["why"]
    ]  # fmt: skip
    notes = [_tell_behind(ours, sets) for ours in GIVEN_OURS]
    notes += [f"No scene by {', '.join(without)}."] if without else []
    notes += [f"{found['note'][0].upper()}{found['note'][1:]}."] if found["note"] else []
    beside = [_compare_given(ours, rival, sets) for ours in GIVEN_OURS for rival in GIVEN_RIVALS]
    header = (
        *(
            "preset",
            "beside",
            "sets that both have",
            "lead in PSNR, mean",
            "PSNR at least as high",
            "time at most as long",
        ),
        *("both", "its time over the other's, median"),
    )
    head = "set, views", "points", *(f"`{each}`" for each in GIVEN_OURS), *GIVEN_RIVALS.values()
    cells = [
        (name, rows[GIVEN_OURS[0]]["points"], *(_tell_given(rows.get(each)) for each in (*GIVEN_OURS, *GIVEN_RIVALS)))
        for name, rows in sets.items()
    ]
    return f"{bullets(*notes)}\n\n{table(header, beside)}\n\n{table(head, cells)}"


def _tell_given(row: dict[str, Any] | None) -> str:
    if row is None:
        return "not run"
    return "no scene" if row["why"] else f"{scores(row)}; {row['processor_seconds']:.0f} s"


def _tell_behind(ours: str, sets: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Says where a preset is worse than the best of the others, and than which it takes longer."""
    clauses = []
    for measure, sign, digits in (("psnr", 1, 2), ("ssim", 1, 3), ("lpips", -1, 3)):
        told = []
        for name, rows in sets.items():
            leads = {
                rival: sign * (rows[ours][measure] - rows[rival][measure])
                for rival in GIVEN_RIVALS if rival in rows and not rows[rival]["why"]
            }  # fmt: skip
            best = min(leads, key=leads.__getitem__, default=None)
            if best is not None and leads[best] < 0:
                told.append(f"{name}: {change(sign * leads[best], digits)} beside {GIVEN_RIVALS[best]}")
        where = f" ({'; '.join(told)})" if told else ""
        clauses.append(f"in {measure.upper()} in {len(told)} of {len(sets)} sets{where}")
    longer = []
    for rival in GIVEN_RIVALS:
        times = [mine["processor_seconds"] / other["processor_seconds"] for mine, other in _pair(ours, rival, sets)]
        if slow := sum(time > 1 for time in times):
            longer.append(f"{GIVEN_RIVALS[rival]} in {slow} of {len(times)}")
    slower = f" It takes longer than {', '.join(longer)}." if longer else " It takes longer than none of them."
    return f"`{ours}` is behind the best of the others {', '.join(clauses)}.{slower}"


def _pair(
    ours: str, rival: str, sets: dict[str, dict[str, dict[str, Any]]]
) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Returns the rows of both where both have a scene."""
    return [(rows[ours], rows[rival]) for rows in sets.values() if rival in rows and not rows[rival]["why"]]


def _compare_given(ours: str, rival: str, sets: dict[str, dict[str, dict[str, Any]]]) -> tuple[object, ...]:
    """Returns what a preset is beside another recipe, where both have a scene."""
    pairs = _pair(ours, rival, sets)
    leads = [mine["psnr"] - other["psnr"] for mine, other in pairs]
    times = [mine["processor_seconds"] / other["processor_seconds"] for mine, other in pairs]
    both = sum(lead >= 0 and time <= 1 for lead, time in zip(leads, times, strict=True))
    counts = sum(lead >= 0 for lead in leads), sum(time <= 1 for time in times), both
    return f"`{ours}`", GIVEN_RIVALS[rival], len(pairs), change(mean(leads), 2), *counts, part(median(times), 2)


def odometry_sets() -> str:
    """Sets that images alone refuse, with odometry that drifts."""
    refused, rows = [row for row in raw("odometry_sets")["rows"] if row["verdict"]], []
    for words, is_apart in (("`NO_OVERLAP`", True), ("another", False)):
        group = [row for row in refused if (row["alone"] == "NO_OVERLAP") == is_apart]
        answered = [row for row in group if row["placed"]]
        within = sum(max(row["rotation_over_bound"], row["centre_over_bound"]) <= 1 for row in answered)
        most = max(max(row["rotation_over_bound"], row["centre_over_bound"]) for row in answered)
        metres = sum(row["scale_sigmas"] <= 1.96 for row in answered)
        counts = len(group), len(answered), sum(row["wrong"] for row in answered), within, f"{most:.1f}", metres
        rows.append((words, *counts))
    header = (
        "verdict without odometry",
        "sets",
        "answered with it",
        "wrong",
        "all cameras within their bounds",
        "largest error over bound",
        "metres within their interval",
    )
    return table(header, rows)


def hard_sets() -> str:
    """Hard sets of 3, 6 and 12 views, and how long cameras and depth take."""
    poses = raw("poses")
    total, rows = poses["summary"], poses["rows"]
    stages = ("features", "matching", "mapping", "verification")
    seconds = [
        median(sum(row[f"seconds_{stage}"] for stage in stages) for row in rows if row["views"] == views)
        for views in (3, 6, 12)
    ]
    depth = [row["seconds"]["points"] / row["views"] for row in raw("replay")["rows"]]
    scenes, beyond = len({row["scene"] for row in rows}), len(total["false_accepts"])
    return bullets(
        f"Of {total['sets']} hard sets from {scenes} real scenes {total['published']} were published, "
        f"{total['right']} of them within 2° and 5 %, {beyond} beyond its claim.",
        f"Cameras with their verification take {seconds[0]:.1f}, {seconds[1]:.1f} and {seconds[2]:.1f} s in the median "
        f"at 3, 6 and 12 views beside other work; depth {span(depth, 1)} s a view (`replay.json`).",
    )


def told_lenses() -> str:
    """Cameras of real photographs through a known lens."""
    found = raw("told_lenses")["rows"]
    require({row["verdict"] for row in found} == {"OK"}, "all are OK")
    rows, worse = [], {"rotation_error_deg": 0, "centre_error_pct": 0}
    for first in range(0, len(found), 5):
        straight, *bent = of_set = found[first : first + 5]
        cells = [f"{part(row['rotation_error_deg'], 2)}, {part(row['centre_error_pct'], 2)}" for row in of_set]
        rows.append((f"{straight['scene']}, {straight['views']}", *cells))
        for error in worse:
            worse[error] += sum(row[error] > 1.5 * straight[error] for row in bent)
    header = ("set, views", "as they came", "k −.25, 0", "k −.25, +.1", "k +.1, 0", "fisheye")
    note = (
        f"All are `OK`. Of {len(found) - len(rows)} bent sets {worse['rotation_error_deg']} turns and "
        f"{worse['centre_error_pct']} move a camera by more than 1.5 times the error of the photographs as they came."
    )
    return f"{table(header, rows)}\n\n{bullets(note)}"


def unknown_lenses() -> str:
    """Lenses of which nothing is known."""
    found = raw("unknown_lenses")["rows"]
    radial = [row for row in found if not row["lens"].startswith("fisheye")]
    require(all(row["published"] and row["verdict"] == "OK" for row in radial), "radial lenses are OK")
    rows = []
    for name in dict.fromkeys(row["lens"] for row in found if row["corner_moves_pct"]):
        group = [row for row in found if row["lens"] == name]
        errors = [max(row[k] for row in group) for k in ("corner_error_px", "rotation_error_deg", "centre_error_pct")]
        shown = f"{errors[0]:.1f} px", f"{part(errors[1], 3)}°", f"{part(errors[2], 3)} %"
        verdicts = ", ".join(dict.fromkeys(row["verdict"] for row in group))
        rows.append((_name_lens(name), f"{group[0]['corner_moves_pct']:.0f} %", verdicts, *shown))
    wide = [row for row in found if row["corner_moves_pct"] is None]
    require(len(wide) == 2 and not any(row["published"] for row in wide), "170 degrees is refused")
    return table(("lens", "a corner moves", "verdict", "corner's error", "rotations", "centres"), rows)


def _name_lens(name: str) -> str:
    words = name.replace("-", "−").replace("+0.", "+.").replace("−0.", "−.")
    return words.replace("k2 +0", "k2 0").replace("k1 +0, k2 0", "none")


def bent() -> str:
    """An unknown radial lens that is estimated and taken out, or left."""
    found = raw("bent")["rows"]
    undistorted, raw_images = ([r for r in found if r["kind"] == kind] for kind in ("straight", "as photographed"))
    rows = []
    for row, other in zip(undistorted, raw_images, strict=True):
        require(row["straightened"] and all(row[k] == other[k] for k in ("scene", "k1", "k2")), "pairs of runs")
        true, estimate = ((row[f"{which}k1"], row[f"{which}k2"]) for which in ("", "estimated_"))
        shift = f"{-row['corner_shift_px']:.0f} px"
        quality = (
            " / ".join((f"{r['psnr']:.1f}", part(r["ssim"], 3), part(r["lpips"], 3))) for r in (row, other)
        )  # fmt: skip
        rows.append((row["scene"], _name_terms(*true, 2), _name_terms(*estimate, 3), shift, *quality))
    untouched = [row for row in found if not row["k1"]]
    (refused,) = (row for row in found if row["estimated_k1"] is None)
    require(len(untouched) == 7 and not any(row["straightened"] for row in untouched), "seven sets stay as they are")
    (fern,) = (row for row in undistorted if (row["scene"], row["k1"], row["k2"]) == ("llff_fern", -0.25, 0))
    most = max(abs(row["corner_shift_px"]) for row in untouched) + 0.05
    notes = bullets(
        f"{refused['scene']} bent by {_name_terms(refused['k1'], refused['k2'], 2)} is refused "
        f"(`{refused['verdict']}`).",
        f"llff_fern bent by −.25 is {part(fern['rotation_error_deg'], 2)} degrees and {fern['focal_error_pct']:.1f} % "
        "of the focal length off.",
        f"Of the seven sets as they came none moves a corner by more than {most:.1f} pixels, and all stay as they are.",
    )
    header = ("set, 6 views", "k1, k2", "estimate", "corner moves", "undistorted", "left")
    return f"{table(header, rows)}\n\n{notes}"


def _name_terms(k1: float, k2: float, digits: int) -> str:
    return f"{change(k1, digits)}, {change(k2, digits) if k2 else 0}"


def fisheyes() -> str:
    """A calibrated fisheye beside a pinhole of the same field."""
    found = {(row["across_deg"], row["views"], row["lens"]): row for row in raw("fisheyes")["results"]}
    rows = []
    for across, views in [(across, views) for across, views, lens in found if lens == "fisheye"]:
        row, other = (found[across, views, lens] for lens in ("fisheye", "pinhole"))
        errors = f"{row['rotation_error_deg']:.3f}", f"{row['centre_error_pct']:.3f}"
        rows.append((f"{across:.0f}°, {views}", row["verdict"], *errors, f"{row['psnr']:.1f}", f"{other['psnr']:.1f}"))
    return table(("across, views", "verdict", "rotation, °", "centre, %", "PSNR", "pinhole's PSNR"), rows)


def calibration() -> str:
    """`splatnode calibrate` on a rendered board."""
    found, rows = raw("calibrate")["results"], []
    require(not any(row["missing"] for row in found), "no calibration is missing")
    for lens in dict.fromkeys(row["lens"] for row in found):
        group = [row for row in found if row["lens"] == lens]
        (model,) = {row["model"] for row in group}
        focal, corner = (max(row[error] for row in group) for error in ("focal_error_pct", "corner_error_px"))
        require(len(group) == 4 and focal < 0.2 and corner < 0.3, "four draws, within .2 % and .3 px")
        sigma = median(row["corner_sigma_px"] for row in group)
        rows.append((lens, f"`{model}`", f"{focal:.3f}", part(corner, 2), part(sigma, 2)))
    held = sum(row["corner_error_px"] <= 2 * row["corner_sigma_px"] for row in found)
    note = f"The worst corner was within two of the stated standard deviations in {held} of {len(found)} calibrations."
    header = ("lens", "model chosen", "focal length, %", "corner, px", "stated sigma, px")
    return f"{table(header, rows)}\n\n{bullets(note)}"


def locate() -> str:
    """Held-out photographs in a saved scene, and photographs of other scenes."""
    found = raw("locate")
    trials, sums = found["trials"], found["summary"]
    covered, placed = [t for t in trials if t["covered"]], [t for t in trials if t["outcome"] == "placed"]
    exact = [t for t in covered if _is_exact(t)]
    require((len(exact), len(placed)) == (sums["covered_and_right"], sums["placed"]), "the summary is of the trials")
    most = [max(trial[key] for trial in placed) for key in ("rotation_deg", "centre_percent")]
    turned = sum(t["rotation_deg"] > t["rotation_claim_deg"] for t in placed)
    moved = [t["scene"] for t in placed if t["centre_percent"] > t["centre_claim_percent"]]
    shares = [percent(1 - count / len(placed)) for count in (turned, len(moved))]
    apart = [pair for pair in found["strangers"] if not pair["same_place"]]
    courtyard = [pair for pair in found["strangers"] if pair["same_place"]]
    plain, near = (sum(pair[k] == "placed" for pair in apart) for k in ("outcome", "outcome_following"))
    kitti, elsewhere = "hard_kitti_forward1", [t for t in placed if t["scene"] != "hard_kitti_forward1"]
    inexact = [t for t in covered if not _is_exact(t)]
    off = sorted(t["centre_percent"] for t in inexact if t["outcome"] == "placed")
    require(all(frame["quickly"] for frame in found["frames"]), "each frame is found near the one before")
    sets = {(t["scene"], t["views"]) for t in trials}
    rows = [
        (f"held-out photographs of {len(sets)} sets, {len({s for s, _ in sets})} real scenes", len(trials)),
        ("of these, with 30 matches to two photographs of the scene", len(covered)),
        ("of those, placed within 1° and 1 % of the distance", f"{len(exact)} ({percent(len(exact) / len(covered))})"),
        ("placed in all; largest error", f"{len(placed)}; {most[0]:.2f}°, {most[1]:.2f} %"),
        ("95 % bounds hold, rotations; centres", "; ".join(shares)),
        ("photographs of other scenes that were placed", f"{plain} of {len(apart)}; with `near` {near}"),
        ("seconds of one core: alone", _seconds([t["seconds"] for t in trials])),
        ("near a photograph 3° and a tenth of the distance away", _seconds([t["seconds_following"] for t in trials])),
        ("near the frame of a film before it", _seconds([frame["seconds"] for frame in found["frames"]])),
    ]
    notes = bullets(
        f"{moved.count(kitti)} of the {len(moved)} centres beyond their bounds are of {kitti}, whose true cameras "
        "are of "
        f"GPS and IMU; elsewhere {len(moved) - moved.count(kitti)} of {len(elsewhere)}.",
        f"Of the {len(inexact)} inexact ones {len(inexact) - len(off)} was refused; the others are {off[0]:.1f} to "
        f"{off[-1]:.1f} % off.",
        f"Four scenes show one courtyard: of their {len(courtyard)} pairs "
        f"{sum(pair['outcome'] == 'placed' for pair in courtyard)} were placed, which is right, and do not count.",
    )
    return f"{table(('', ''), rows)}\n\n{notes}"


def _is_exact(trial: dict[str, Any]) -> bool:
    return trial["outcome"] == "placed" and trial["rotation_deg"] <= 1 and trial["centre_percent"] <= 1


def _seconds(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{median(known):.2f} in the median, {max(known):.2f} at most"


def query_lenses() -> str:
    """Query images of another lens than the scene's."""
    sums = raw("query_lenses")["summary"]
    rows = []
    for words, warps in QUERIES.items():
        kinds = [sums["all"]["kinds"][warp] for warp in warps]
        rows.append((words, *(sum(kind[count] for kind in kinds) for count in ("queries", "placed", "wrong"))))
    every, chosen, new = (sums[key] for key in ("all", "chosen_on", "left_out"))
    shares = [f"{half['zoomed_placed']} ({percent(half['zoomed_placed'] / half['zoomed'])})" for half in (chosen, new)]
    within = [percent(every["within"][kind]) for kind in ("rotation", "centre", "focal")]
    notes = bullets(
        f"Of {every['queries']} zoomed, cropped and mirrored queries {every['wrong']} were wrong: {chosen['wrong']} on "
        f"scenes that thresholds were chosen on, {new['wrong']} on the others. Zoomed ones placed: {shares[0]} and "
        f"{shares[1]}.",
        f"95 % bounds hold for {within[0]} of the rotations, {within[1]} of the centres, {within[2]} of the focal "
        "lengths.",
    )
    return f"{table(('queries', 'number', 'placed', 'wrong'), rows)}\n\n{notes}"


def audit() -> str:
    """Moves of cameras that an audit notices, and none."""
    checks = raw("audit")["checks"]
    real = {each["scene"] for each in checks} - {"built-in"}
    unseen = {name for name in real if name.startswith("hard") or name in ("kitchen", "goldcape")}
    require((len(real), len(unseen)) == (12, 5), "twelve real scenes, five of them new")

    def split(kind: str) -> list[list[dict[str, Any]]]:
        here = [each for each in checks if each["kind"] == kind]
        return [[each for each in here if (each["scene"] in unseen) == new] for new in (False, True)]

    rows: list[tuple[str, ...]] = []
    for kind, words in (
        ("still", "noticed though nothing moved"),
        ("turned", "noticed: turned by .3°"),
        ("shifted", "noticed: shifted by .5 % of the distance (built-in)"),
    ):
        counts = (f"{sum(c['noticed'] for c in each)} of {len(each)}" if each else "–" for each in split(kind))
        rows.append((words, *counts))
    least = [[[each[f"least_{what}"] for each in group] for what in LEAST] for group in split("still")]
    usual = [f"{part(median(turns), 2)}°, {part(median(shifts), 2)} %" for turns, shifts in least]
    most = [[quantiles(values, n=20, method="inclusive")[-1] for values in group] for group in least]
    worst = [f"{part(max(turns), 2 if max(turns) < 1 else 1)}°, {max(shifts):.1f} %" for turns, shifts in least]
    rows.append(("would have been noticed, median", *usual))
    rows.append(("the same, 95 % at most", *(f"{part(turn, 2)}°, {part(shift, 2)} %" for turn, shift in most)))
    rows.append(("the same, worst", *worst))
    within = [f"{sum(e['error_sigmas'] ** 2 < WITHIN_95 for e in group)} of {len(group)}" for group in split("pair")]
    rows.append(("real moves within their 95 % region", *within))
    beyond = [each for each in checks if each["kind"] == "pair" and each["error_sigmas"] ** 2 >= WITHIN_95]
    require({each["scene"] for each in beyond} == {"hard_kitti_forward1"}, "only hard_kitti_forward1 is beyond")
    note = bullets(
        f"The {len(beyond)} beyond are of hard_kitti_forward1, whose true cameras are of GPS and IMU: up to "
        f"{max(each['error_sigmas'] for each in beyond):.1f} standard deviations."
    )
    return f"{table(('', 'built-in capture and seven scenes', 'five others'), rows)}\n\n{note}"


BLOCKS = (
    windows,
    bounds,
    lens_assumptions,
    several_cameras,
    rigs,
    rgbd,
    rgbd_real,
    odometry_walk,
    plain_rooms,
    plain_view,
    known_poses,
    given_scenes,
    odometry_sets,
    hard_sets,
    told_lenses,
    unknown_lenses,
    bent,
    fisheyes,
    calibration,
    locate,
    query_lenses,
    audit,
)
