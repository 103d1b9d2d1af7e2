"""docs/scene_quality.md: quality, time and size of scenes."""

from __future__ import annotations

import re
from statistics import mean
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from splatnode.recon.result import stored_snapshot
from tests.reference.measured.raw import (
    average_over_sets,
    bullets,
    change,
    ends,
    part,
    percent,
    raw,
    require,
    scores,
    table,
    thousands,
)

METHODS = ("preview", "fast", "balanced", "quality", "instantsplat-s", "instantsplat-xl", "paper")
RIVALS = ("fast", "colmap-3dgs", "colmap-fsgs", "cf-3dgs", "nope-nerf", "nerfmm")
SIZES = {
    "x0.25": "a quarter of the size",
    "x0.5": "half",
    "chosen": "chosen by splatnode",
    "x2": "twice",
    "x4": "four times",
    "mcmc": "MCMC, same size",
    "pixel": "a Gaussian a pixel",
}


def single_runs() -> str:
    """Quality, size, memory and time of single runs."""
    demo = raw("demo")
    held_out = f"{demo['held_out']['psnr']:.1f} / {part(demo['held_out']['ssim'], 3)} / –"
    size, memory = thousands(demo["num_gaussians"]), f"{demo['peak_rss_mb'] / 1e3:.2f} GB"
    rows = [(f"built-in capture, {demo['num_cameras']} views (`./run demo`)", held_out, size, memory, "–")]
    for row in raw("replay")["rows"]:
        scored = ends("bench_7sets", scene=row["scene"], views=row["views"], method=row["preset"], seed=0)
        if row["scene"] != "fox":
            quality = scores(scored[0], "lpips_alex") if scored else "–"
            cost = thousands(row["num_gaussians"]), f"{row['peak_rss_mb'] / 1e3:.2f} GB"
            name = f"{row['scene']}, {row['views']} views, `{row['preset']}`"
            rows.append((name, quality, *cost, f"{row['seconds']['total']:.1f}"))
    return table(("set", "PSNR / SSIM / LPIPS", "Gaussians", "peak memory", "seconds"), rows)


def recipes() -> str:
    """Presets beside InstantSplat and the paper's losses, in the mean of seven sets."""
    for name in ("bench_7sets", "bench_7sets_before"):
        views = {(row["scene"], row["views"]) for row in ends(name)}
        require(views == {(s, 12 if s in ("castle_p30", "fox") else 6) for s, _ in views}, "6 views, 12 of castle, fox")
        require(len(views) == 7, "seven sets")
    require({row["seed"] for row in ends("bench_7sets")} == {0}, "one seed")
    rows = []
    for method in METHODS:
        found = ends("bench_7sets", method=method)
        name = f"`{method}`" if found else f"`{method}`, older code"
        means = average_recipe(found or ends("bench_7sets_before", method=method))
        cost = thousands(means["num_gaussians"]), f"{means['seconds']:.0f}"
        rows.append((name, scores(means, "lpips_alex"), *cost))
    return table(("", "PSNR / SSIM / LPIPS", "Gaussians", "s"), rows)


def average_recipe(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Returns means over sets: scores, Gaussians, and seconds of the sets in which all methods were timed alone."""
    keys = ("psnr", "ssim", "lpips_alex", "num_gaussians")
    means = {key: average_over_sets(rows, lambda row, key=key: row[key]) for key in keys}
    busy = {row["scene"] for row in ends("bench_7sets") if row["seconds"]["total"] is None}
    timed = [row for row in rows if row["scene"] not in busy]
    return {**means, "seconds": average_over_sets(timed, lambda row: row["seconds"]["total"])}


def recipe_losses() -> str:
    """Where the other recipes are better or differ, and what a seed changes."""
    sharper = []
    for scene in ("llff_flower", "llff_fern", "fox"):
        xl, ours = (
            mean(row["lpips_alex"] for row in ends("bench_7sets", method=method, scene=scene))
            for method in ("instantsplat-xl", "balanced")
        )
        require(xl < ours, f"InstantSplat-XL has the better LPIPS on {scene}")
        sharper.append(scene)
    scenes = ("fountain_p11", "sceaux", "castle_p30", "llff_fern", "llff_flower", "tum_fr3_office", "fox")
    before = "bench_7sets_before"
    changes = [
        f"{scene} {change(_average_psnr('paper', scene, before) - _average_psnr('instantsplat-xl', scene, before))}"
        for scene in scenes
    ]
    alone = {row["method"]: row["psnr"] for row in ends("ablation_6views")}
    point, depth, normal = (
        change(alone[f"instantsplat-xl+{term}"] - alone["instantsplat-xl"], 2)
        for term in ("point-render", "depth", "normal")
    )
    spreads = []
    for method in METHODS:
        for scene in {row["scene"] for row in ends(before)}:
            values = [row["psnr"] for row in ends(before, method=method, scene=scene)]
            require(len(values) in (1, 3), "one or three seeds")
            spreads += [max(values) - min(values)] if len(values) == 3 else []
    return bullets(
        f"`instantsplat-xl` has the better LPIPS on {', '.join(sharper)}.",
        f"`paper` changes the PSNR of `instantsplat-xl`, in dB, with older code (`{before}.json`): "
        f"{', '.join(changes)}. On sceaux, with one seed, its "
        f"point-rendered loss alone changes it by {point}, the depth loss by {depth}, the normal loss by {normal} "
        "(`ablation_6views.json`).",
        f"The best and the worst of three seeds of a method lie {part(min(spreads), 2)} to {part(max(spreads), 2)} dB "
        "apart on a set, there. Smaller differences between methods mean nothing.",
    )


def black_rim() -> str:
    """What a black rim changes, and by how much splatnode is behind where it stands on a choice of views."""
    (row,) = ends("bench_7sets", scene="llff_fern", method="balanced", seed=0)
    cases = {(r["scene"], r["views"], r["method"]): r["psnr"] for r in raw("parsimony")["rows"]}
    pixel, mcmc = (
        cases["castle_p30", 6, method] - cases["castle_p30", 6, "chosen"] for method in ("pixel", "mcmc")
    )  # fmt: skip
    return bullets(
        "**The sets are a choice.** castle_p30 stands below with 12 views. With 6, before the background went all "
        f"around, a Gaussian a pixel had {pixel:.1f} dB more than splatnode, and MCMC of the same size {mcmc:.1f} dB.",
        "**Black rims do not count**, alike for all methods. No scene explains the rim that undistortion leaves. On "
        f"llff_fern `balanced` has {row['psnr']:.1f} dB without the rim, {row['psnr_with_rim']:.1f} with it "
        "(`psnr_with_rim` in every row).",
    )


def _average_psnr(method: str, scene: str, name: str = "bench_7sets") -> float:
    return mean(row["psnr"] for row in ends(name, method=method, scene=scene))


def pose_free_rivals() -> str:
    """Methods that find their own poses, cut down to a CPU."""
    rows = []
    for method in RIVALS:
        found = [ends("bench_rivals", method=method, scene=scene)[0] for scene in ("fountain_p11", "llff_fern")]
        cells = (f"{row['psnr']:.1f} dB, {row['rotation_error_deg']:.1f}°" for row in found)
        rows.append(("`nerfmm` (NeRF--)" if method == "nerfmm" else f"`{method}`", *cells))
    return table(("", "fountain_p11", "llff_fern"), rows)


def long_rivals() -> str:
    """The rivals that end in Gaussians, run as long as published."""
    rows = []
    for row in raw("bench_published")["rows"]:
        seconds = row["seconds"]["total"]  # None where others took more of the core than is allowed
        minutes = "–" if seconds is None else f"{seconds / 60:.0f}"
        before = ends("bench_rivals", method=row["method"].removesuffix("+published"), scene=row["scene"])[0]["psnr"]
        size = thousands(row["num_gaussians"])
        gain = change(row["psnr"] - before)
        rows.append((row["scene"], f"`{row['method']}`", scores(row, "lpips_alex"), gain, size, minutes))
    require(sum(row[3].startswith("−") for row in rows) == len(rows) - 1, "most lose by longer runs")
    return table(("set", "method", "PSNR / SSIM / LPIPS", "PSNR by it", "Gaussians", "minutes"), rows)


def sizes() -> str:
    """Mean scores of scenes of other sizes."""
    rows = []
    for method, words in SIZES.items():
        found = [row for row in raw("parsimony")["rows"] if row["method"] == method]
        means = {key: mean(row[key] for row in found) for key in ("psnr", "ssim", "lpips", "num_gaussians")}
        rows.append((words, scores(means), thousands(means["num_gaussians"])))
    return table(("", "PSNR / SSIM / LPIPS", "Gaussians"), rows)


def size_notes() -> str:
    """Where another size is better, what a scene weighs, and what fewer iterations cost."""
    found = raw("parsimony")
    cases: dict[tuple[str, int], dict[str, dict[str, Any]]] = {}
    for row in found["rows"]:
        cases.setdefault((row["scene"], row["views"]), {})[row["method"]] = row
    gains = {case: rows["pixel"]["psnr"] - rows["chosen"]["psnr"] for case, rows in cases.items()}
    worse = ", ".join(
        f"{scene} at {views} ({part(gain, 1)})" for (scene, views), gain in gains.items() if gain > 0
    )  # fmt: skip
    summary, chosen = found["summary"], [rows["chosen"] for rows in cases.values()]
    a_gaussian = mean(row["spz_bytes"] / row["num_gaussians"] for row in chosen)
    kept = [row["psnr_to_ply"] for row in raw("spz")["rows"]]
    budgets = raw("budgets")
    psnr = {(row["scene"], row["limit"], row["value"]): row["psnr"] for row in budgets["rows"]}
    after = ", ".join(f"{psnr['fountain_p11', 'iterations', n]:.1f} dB after {n}" for n in (25, 100, 500))
    falls = [re.fullmatch(r"fountain_p11 6, .* psnr ([\d.]+) to ([\d.]+)", fall) for fall in budgets["falls"]]
    require(all(fall and 0.05 <= float(fall[1]) - float(fall[2]) < 0.15 for fall in falls), "PSNR falls by .1 dB once")
    return bullets(
        f"A Gaussian a pixel has the better PSNR, by so many dB, on {worse}.",
        f"In {summary['on_front']['together']} of {summary['cases']} cases no row with as few Gaussians is as good in "
        "all three measures.",
        _race_sizes(),
        f"The mean scene of 6 views takes {summary['spz_mb_6_views']:.2f} MB as `.spz`, {a_gaussian:.0f} bytes a "
        f"Gaussian. Its renders keep {min(kept):.0f} to {max(kept):.0f} dB to those of `scene.ply` ({len(kept)} "
        "scenes, `spz.json`).",
        f"fountain_p11 by iterations: {after} (`budgets.json`). Each higher limit is better in all measures, but for "
        ".1 dB at the last step there.",
    )


def _race_sizes() -> str:
    found = raw("parsimony_race")
    rows = {(row["scene"], row["views"], row["method"]): row for row in found["rows"]}
    sets = dict.fromkeys(each[:2] for each in rows)

    def mean_change(method: str) -> str:
        pairs = [(rows[(*each, method)], rows[(*each, "chosen")]) for each in sets]
        psnr, ssim, lpips = (mean(other[k] - own[k] for other, own in pairs) for k in ("psnr", "ssim", "lpips"))
        return f"{change(psnr, 2)} dB / {change(ssim, 3)} / {change(lpips, 3)}".replace("−.00 dB", "0 dB")

    twice = found["summary"]["twice_is_better"]
    return (
        f"On {len(sets)} sets of the race (`parsimony_race.json`) half of the size changes the mean by "
        f"{mean_change('x0.5')} and is worse in two or three measures in {found['summary']['half_is_worse']}; twice "
        f"changes it by {mean_change('x2')} and is better by more than .1 dB in {twice['psnr']}, .003 SSIM in "
        f"{twice['ssim']}, 2 % LPIPS in {twice['lpips']}. What more Gaussians bring is texture."
    )


def merged_scene() -> str:
    """One scene of two."""
    (one,) = raw("merge")["maps"]
    free, bounded = one["merged"]
    rows = []
    for scene in ("scene-0001", "scene-0002"):
        each = (mean(scores[scene].values()) for scores in (one["alone"], free["held_out"], bounded["held_out"]))
        rows.append((scene, *(f"{psnr:.1f}" for psnr in each)))
    given, kept = (f"{count:,}".replace(",", " ") for count in (free["gaussians_given"], free["num_gaussians"]))
    size = f"{free['bytes'] / 1e6:.1f} MB, {free['seconds']:.0f} s"
    header = ("PSNR, dB", f"alone, {given} Gaussians in both", f"merged, {kept} ({size})", "merged to 20 000")
    return table(header, rows)


def gpu() -> str:
    """What the GPU gives beside the core."""
    found = raw("gpu")
    figures, times = {each["name"]: each for each in found["figures"]}, found["times"]
    require(all(abs(each["value"]) <= each["bound"] for each in figures.values()), "the GPU gives what the core gives")
    pixels = max(each["value"] for name, each in figures.items() if name.endswith("a pixel"))
    gradients = max(each["value"] for name, each in figures.items() if "gradient" in name)
    require(pixels <= 6e-6 and gradients <= 2e-6, "pixels within 6e-6, gradients within 2e-6")
    require(abs(figures["built-in capture: held-out PSNR, dB"]["value"]) <= 0.02, "within .02 dB")
    whole = [ms for name, ms in times.items() if name.endswith("_all, ms an iteration")]
    name = "built-in capture, balanced, 52498 Gaussians at first, on {}, ms an iteration"
    cuda, cpu = (times[name.format(device)] for device in ("cuda", "cpu"))
    machine = f"{found['machine']['gpu']}, {found['machine']['cores']} cores"
    return bullets(
        f"The machine: {machine} (`gpu.json`). Pixels are within 6e-6 of the core's, gradients within 2e-6 of their "
        "length, held-out PSNR of the built-in capture within .02 dB.",
        "An iteration with 20 000 to 150 000 Gaussians at 512 x 384, with depth and normals, takes "
        f"{min(whole):.1f} to "
        f"{max(whole):.1f} ms. That of `balanced` on the built-in capture takes {cuda:.1f} ms, on 16 cores {cpu:.1f}.",
    )


def gpu_runs() -> str:
    """Whole runs, on the GPU and on 16 cores."""
    found, runs = raw("bench_gpu"), {}
    for device, words in (("cuda", "H200"), ("cpu", "16 cores")):
        for row in found[device]["rows"]:
            method = "InstantSplat-XL" if row["method"] == "instantsplat-xl" else f"`{row['method']}`"
            seconds = f"{row['seconds']['optimise']:.1f} + {row['seconds']['total'] - row['seconds']['optimise']:.1f} s"
            runs[f"{method}, {words}", row["scene"]] = f"{row['psnr']:.1f} dB, {seconds}"
    scenes = ("fountain_p11", "llff_fern")
    totals = {
        d: [r["seconds"]["total"] for r in found[d]["rows"] if r["method"] == "balanced"] for d in ("cuda", "cpu")
    }
    require(max(abs(a - b) for a, b in zip(*totals.values(), strict=True)) < 0.2, "a GPU gains nothing for balanced")
    names = dict.fromkeys(name for name, _ in runs)
    return table(("refinement + the rest", *scenes), [(n, *(runs[n, scene] for scene in scenes)) for n in names])


def growth() -> str:
    """Time and memory by number of photographs."""
    rows = raw("growth")["rows"]

    def seconds(value: float) -> str:
        return f"{value:.0f}" if value >= 10 else f"{value:.1f}"

    cells = [
        ("all, s", *(seconds(row["seconds"]["total"]) for row in rows)),
        ("cameras and verification, s", *(seconds(row["seconds"]["poses"]) for row in rows)),
        ("coarse preview after, s", *(seconds(row["first_scene_s"]) for row in rows)),
        ("peak memory, GB", *(f"{row['peak_rss_mb'] / 1e3:.2f}" for row in rows)),
    ]
    return table(("photographs", *(str(row["views"]) for row in rows)), cells)


def consistent_depth() -> str:
    """Quality away from the cameras by the share of multi-view consistent depth."""
    every = list(raw("consistent_depth")["rows"].values())
    found = [row for row in every if row["consistent_depth"] is not None]
    limit = stored_snapshot.ConsistentDepthConfig().min_share
    rows = []
    for words, kept in (
        (f"below {percent(limit)}", [row for row in found if row["consistent_depth"] < limit]),
        (f"{percent(limit)} and more", [row for row in found if row["consistent_depth"] >= limit]),
    ):
        psnr, poor = [row["psnr"] for row in kept], [view["psnr"] < 20 for row in kept for view in row["held_out"]]
        ssim = part(float(np.mean([row["ssim"] for row in kept])), 3)
        quality = f"{np.mean(psnr):.1f} dB, {min(psnr):.1f} to {max(psnr):.1f}"
        rows.append((words, len(kept), quality, ssim, percent(float(np.mean(poor)))))
    correlation, _ = spearmanr([row["consistent_depth"] for row in found], [row["psnr"] for row in found])
    shares, pairs = [row["consistent_depth"] for row in found], sum(len(row["photographs"]) == 2 for row in every)
    header = ("share", "sets", "PSNR of held-out views", "SSIM", "views below 20 dB")
    looks_bad = [row for row in found if row["consistent_depth"] >= limit and row["psnr"] < 20]
    require(len(looks_bad) >= 2, "a set above the limit can look bad")
    notes = bullets(
        f"{len(every) - pairs} sets of three to twelve views and {pairs} pairs; {len(found)} were published, with "
        f"shares of {100 * min(shares):.0f} to {percent(max(shares))}. Rank correlation of share and PSNR: "
        f"{part(float(np.asarray(correlation)), 2)}.",
        f"{len(looks_bad)} sets above the limit have less than 20 dB, with shares up to "
        f"{percent(max(row['consistent_depth'] for row in looks_bad))}: held-out views show what no photograph does.",
    )
    return f"{table(header, rows)}\n\n{notes}"


def free_path() -> str:
    """What it changes, set by set, that guessed surfaces stay off the path of the cameras."""
    every = {(row["set"], row["clearance"]): row for row in raw("free_path")["rows"]}
    pairs = {name: (row, every[name, "without"]) for (name, clearance), row in every.items()
             if clearance == "with" and row["psnr"] is not None}  # fmt: skip
    changes = {name: [ours[key] - before[key] for key in ("psnr", "ssim", "lpips")]
               for name, (ours, before) in pairs.items()}  # fmt: skip
    rows = [
        (name.replace(":", ", "), change(psnr, 2), change(ssim, 3), change(lpips, 3))
        for name, (psnr, ssim, lpips) in sorted(changes.items(), key=lambda item: -item[1][0])
    ]
    psnr, ssim, lpips = np.mean(list(changes.values()), axis=0)
    size = mean(ours["num_gaussians"] / before["num_gaussians"] for ours, before in pairs.values())
    notes = bullets(
        f"Mean of {len(changes)} sets: {change(psnr, 2)} dB, {change(ssim, 3)} SSIM, {change(lpips, 3)} LPIPS, with "
        f"{size:.2f} times the Gaussians. PSNR is worse by .1 dB or more in "
        f"{sum(each[0] <= -0.095 for each in changes.values())}, better by as much in "
        f"{sum(each[0] >= 0.095 for each in changes.values())}.",
    )
    return f"{table(('set, views', 'PSNR', 'SSIM', 'LPIPS'), rows)}\n\n{notes}"


BLOCKS = (
    single_runs,
    recipes,
    recipe_losses,
    black_rim,
    pose_free_rivals,
    long_rivals,
    sizes,
    size_notes,
    merged_scene,
    gpu,
    gpu_runs,
    growth,
    consistent_depth,
    free_path,
)
