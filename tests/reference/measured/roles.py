"""Which scenes development has tuned on, looked at, or never had, and what was measured on the last from outside."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from tests.conftest import ROOT
from tests.reference.measured.raw import bullets, part, raw, require, table

FILE = ROOT / "tests" / "bench" / "roles.json"
USES = "tuned on", "looked at", "unseen"
FITS = (
    "fit_windows",
    "fit_windows_exif",
    "fit_windows_given",
    "fit_pairs",
    "lens_assumptions",
)  # raw files of the verdict
TUNED_SETS = "bench_7sets"  # raw file of the sets on which presets were chosen


def read_roles() -> dict[str, dict[str, Any]]:
    """Returns what each scene was used for: `cameras`, `scenes`, and `first_look`, the day of its first result."""
    return json.loads(FILE.read_text(encoding="utf-8"))


def find_scenes(content: object) -> set[str]:
    """Returns the scenes that a raw file has results of; windows of a scene have its name and an ending."""
    if isinstance(content, list):
        return set().union(*map(find_scenes, content)) if content else set()
    if not isinstance(content, Mapping):
        return set()
    own = {content["scene"]} if isinstance(content.get("scene"), str) else set()
    return own.union(*map(find_scenes, content.values()))


def roles() -> str:
    """The scenes by what they were used for."""
    known = read_roles()
    rows = []
    for use in USES:
        named = [
            ", ".join(sorted(name for name, role in known.items() if role[what] == use)) or "none"
            for what in ("cameras", "scenes")
        ]
        rows.append((use, *named))
    return table(("scenes", "for cameras, verdict and bounds", "for presets and held-out quality"), rows)


def unseen_windows() -> str:
    """Windows of scenes that development never had."""
    counts = "right", "right_part", "between", "wrong", "refused"
    found = raw("unseen")["windows"]
    rows = [
        (method, *("not told" if row[kind] is None else row[kind] for kind in counts))
        for method, row in found["methods"].items()
    ]
    header = (f"of {found['sets']} windows", "right", "of these in part", "less exact", "wrong", "none")
    three, angles = found["three_views"], found["refused_by_angle_deg"]
    scenes = list(found["right_by_scene"]["scenes"])
    lost = found["right_by_scene"]["splatnode"][scenes.index("B")]
    spread = raw("unseen")["spread_sets"]
    require(spread["right"] == spread["answered"] and not spread["three_views"]["answered"], "spread sets")
    notes = bullets(
        f"Of a slow video (B) splatnode answers {lost} of {found['right_by_scene']['scenes']['B']} windows, COLMAP "
        f"{found['right_by_scene']['COLMAP, default options'][1]}. Below 8° between neighbours it refuses "
        f"{angles['below 8'][0]} of {angles['below 8'][1]}.",
        f"Of {spread['sets']} sets spread over a whole scene it answers {spread['answered']}, all right, and none of "
        f"{spread['three_views']['sets']} with 3 views; with the lens given "
        f"{spread['three_views']['right_with_lens_given']} of these.",
        f"With the lens given {three['right_with_lens_given']} of {three['sets']} windows of 3 views are right, "
        f"{three['right']} without.",
        *(
            f"{each['set']}: {each['verdict']}, with an error of {each['error_over_bound']:g} times its bound."
            for each in raw("unseen")["damaged"]
        ),
    )
    return f"{table(header, rows)}\n\n{notes}"


def unseen_scenes() -> str:
    """Held-out quality on scenes that development never had."""
    found = raw("unseen")["held_out"]
    methods = [name for name in found["rows"][0] if name != "scene"]
    rows = [(row["scene"], *(f"{row[m][0]:.1f} / {part(row[m][1], 3)}" for m in methods)) for row in found["rows"]]
    best = found["after_best_gain"]
    described = (
        f"{name} {psnr:.1f} dB / {part(ssim, 3)} / {part(lpips, 3)} with {count} Gaussians"
        for name, (psnr, ssim, lpips, count) in ((f"`{name}`", best[name]) for name in ("balanced", "InstantSplat-XL"))
    )
    notes = bullets(f"{best['scene']} after the best gain for each held-out image: {', '.join(described)}.")
    header = (f"{found['views']} views, PSNR / SSIM", *methods)
    return f"{table(header, rows)}\n\n{notes}"


BLOCKS: tuple[Callable[[], str], ...] = (roles, unseen_windows, unseen_scenes)
