"""Case by case, ours against the best of the others, so that no mean hides a loss."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt
from statistics import variance

from splatnode.recon.config import PRESETS
from splatnode.recon.evaluate.ablation import is_variant
from splatnode.recon.evaluate.protocol import Row, compute_mean
from splatnode.recon.evaluate.tables import PSNR, SSIM, Measure, Table, format_number

OURS = "balanced"


def _make_region_getter(region: str, name: str) -> Callable[[Row], float | None]:
    return lambda row: getattr(row.regions[region], name) if region in row.regions else None


LPIPS = Measure("LPIPS", lambda row: row.lpips_alex, 4, False)
WHOLE = (PSNR, SSIM, LPIPS)
SHOWN = (  # of the pixels that a training photograph shows
    Measure("PSNR shown", _make_region_getter("shown", "psnr"), 2, True),
    Measure("SSIM shown", _make_region_getter("shown", "ssim"), 4, True),
    Measure("LPIPS shown", _make_region_getter("shown", "lpips_alex"), 4, False),
)


@dataclass(frozen=True)
class Margin:
    """Our mean over seeds and that of the method that is best in this case and measure."""

    scene: str
    views: int
    measure: Measure
    ours: float
    best: float
    by: str
    error: float | None = None  # standard error of `lead`, as seeds have it; None: one of the two has a single seed

    @property
    def lead(self) -> float:
        """How much better ours is; below 0 where it is worse."""
        return (self.ours - self.best) * (1 if self.measure.higher_is_better else -1)


def compute_margins(ends: Sequence[Row], measure: Measure, ours: str = OURS) -> list[Margin]:
    """A margin for each set of photographs that ours and another method, no preset and no variant, were scored on."""
    found = []
    for scene, views in dict.fromkeys((row.scene, row.views) for row in ends):
        here = [row for row in ends if (row.scene, row.views) == (scene, views)]
        values = {
            method: [value for row in here if row.method == method and (value := measure.value(row)) is not None]
            for method in dict.fromkeys(row.method for row in here)
        }
        means = {method: compute_mean(found) for method, found in values.items()}
        others = {m: v for m, v in means.items() if v is not None and m not in PRESETS and not is_variant(m)}
        mine = means.get(ours)
        if mine is None or not others:
            continue
        by = (max if measure.higher_is_better else min)(others, key=lambda method: others[method])
        found.append(
            Margin(scene, views, measure, mine, others[by], by, _compute_standard_error(values[ours], values[by]))
        )
    return found


def _compute_standard_error(ours: Sequence[float], others: Sequence[float]) -> float | None:
    """Seeds of one method have nothing to do with those of another, so the variances of the means add up."""
    if min(len(ours), len(others)) < 2:
        return None
    return sqrt(sum(variance(values) / len(values) for values in (ours, others)))


def make_case_tables(ends: Sequence[Row]) -> list[Table]:
    """One of whole photographs, and one of what the training photographs show of them where that was measured."""
    tables = []
    for title, measures in (("whole held-out photographs", WHOLE), ("what training photographs show", SHOWN)):
        by_measure = {measure.name: compute_margins(ends, measure) for measure in measures}
        leads = {name: found for name, found in by_measure.items() if found}
        if leads:
            tables.append(_make_table(f"`{OURS}` against the best other in each case: {title}", leads))
    return tables


def _make_table(title: str, by_measure: dict[str, list[Margin]]) -> Table:
    names = list(by_measure)
    body = []
    for scene, views in dict.fromkeys((each.scene, each.views) for found in by_measure.values() for each in found):
        cells = [f"{scene} {views}"]
        for name in names:
            here = [each for each in by_measure[name] if (each.scene, each.views) == (scene, views)]
            cells += _format_cells(here[0]) if here else ["–", "–", "–"]
        body.append(tuple(cells))
    total = ["mean lead; cases no worse"]
    for name in names:
        leads = [each.lead for each in by_measure[name]]
        digits = by_measure[name][0].measure.digits
        total += [
            f"{sum(lead >= 0 for lead in leads)} of {len(leads)}",
            "",
            f"{compute_mean(leads) or 0.0:+.{digits}f}",
        ]
    head = ("set", *(cell for name in names for cell in (name, "best other", "lead")))
    return Table(title, head, (*body, tuple(total)))


def _format_cells(margin: Margin) -> list[str]:
    digits = margin.measure.digits
    return [
        format_number(margin.ours, digits),
        f"{format_number(margin.best, digits)} {margin.by}",
        f"{margin.lead:+.{digits}f}",
    ]
