"""What docs/scene_quality.md and README.md say of the race, from its raw numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from math import exp, log, sqrt
from statistics import median

import numpy as np

from splatnode.extras.evaluate.protocol import Row
from splatnode.extras.evaluate.report import OURS, SHOWN, WHOLE, Margin, compute_margins, read_bench
from tests.bench.quality import race_chart
from tests.reference.measured.raw import RESULTS, bullets, part, require, table

RAW = RESULTS / "race.json"
DIGITS = (1, 3, 3)
SAME_FOCAL_PCT = 1.0  # by which the errors of the focal length may differ between rows of a case
LARGEST = "instantsplat-xl+fill"  # the method whose number of Gaussians is told
TUNED = ("castle_p30", "fox", "llff_fern", "llff_flower")  # scenes of which other windows were tuned on
SEEDED = (OURS, "mcmc+fill", "pixel+fill")  # the methods of three seeds
ONE_SEED = ("goldcape", 12)  # where those of others have one


def ends() -> list[Row]:
    return [row for row in read_bench(RAW).rows if row.final]


def race_cases() -> str:
    """A line of the table for each case; those that were refused are named with their verdict."""
    placed = {(row.scene, row.views): row.num_cameras for row in ends() if row.method == OURS}
    require(
        (placed["kitchen", 6], placed["goldcape", 6]) == (2, 3), "two and three cameras of kitchen and goldcape at 6"
    )
    by_measure = [{(each.scene, each.views): each for each in compute_margins(ends(), measure)} for measure in WHOLE]
    rows: list[list[str]] = []
    refused: list[str] = []
    ours = [row for row in ends() if row.method == OURS]
    for case, row in {(row.scene, row.views): row for row in ours}.items():
        name = f"{row.scene}, {row.views}"
        if row.psnr is None:
            refused.append(f"{name} ({row.verdict})")
            continue
        rows.append([name, *(_cell(by_case[case], d) for by_case, d in zip(by_measure, DIGITS, strict=True))])
    lines = table(("set, views", "PSNR, best other", "SSIM, best other", "LPIPS, best other"), rows)
    note = f"Refused: {', '.join(refused)}."
    return f"{lines}\n\n{bullets(note)}"


def race_losses() -> str:
    """What is lost, how far chance reaches, then what is won."""
    return bullets(_losses(), _certainty(), _scenes(), _published_alone(), _paper(), _seeds(), _fast(), _quality())


def _losses() -> str:
    whole, shown = ([compute_margins(ends(), measure) for measure in measures] for measures in (WHOLE, SHOWN))
    lost = [_lost(each, digits) for each, digits in zip(whole, DIGITS, strict=True)]
    means, seen = _leads(whole), _leads(shown)
    refused = _count_refused()
    return (
        f"**What is lost.** `{OURS}` refuses {refused} of {len(whole[0]) + refused} sets. On the other "
        f"{len(whole[0])} it is behind the best other recipe of each set in PSNR in {lost[0]}, in SSIM in {lost[1]}, "
        f"in LPIPS in {lost[2]}. Its mean lead is {means[0]} dB, {means[1]} SSIM and {means[2]} LPIPS (positive is "
        f"better); on pixels that a training view shows {seen[0]} dB, {seen[1]} and {seen[2]}."
    )


def _count_refused() -> int:
    return len({(row.scene, row.views) for row in ends() if row.method == OURS and row.psnr is None})


def _certainty() -> str:
    """How much of the leads is the seeds' chance, from the cases where the best other has several, too."""
    whole = [compute_margins(ends(), measure) for measure in WHOLE]
    known = [[(each.lead, each.error) for each in found if each.error is not None] for found in whole]
    errors = [
        f"{sqrt(sum(error**2 for _, error in found) / len(found) / len(every)):.{digits}f}".replace("0.", ".")
        for found, every, digits in zip(known, whole, (2, 4, 4), strict=True)
    ]
    beyond = sum(abs(lead) > 2 * error for lead, error in known[0])
    return (
        f"The standard error by seeds is {errors[0]} dB, {errors[1]} and {errors[2]}; in {beyond} of {len(known[0])} "
        "sets whose best other has several seeds the difference in PSNR exceeds two of its standard errors."
    )


def _scenes() -> str:
    """The chance of the scenes: resampled with all their sets, at a fixed seed."""
    found, (groups, (low, high)) = compute_margins(ends(), WHOLE[0]), _resample()
    tuned = [each for each in found if _scene(each.scene) in TUNED]
    other = [each for each in found if _scene(each.scene) not in TUNED]
    return (
        f"The error by scenes is larger: the {len(groups)} scenes resampled, the mean lead is {low} to {high} dB "
        f"(95 %). {len(tuned)} sets are other windows of scenes on which presets were tuned "
        f"({_signed(_mean(tuned), 2)} "
        f"dB), {len(other)} are of other scenes ({_signed(_mean(other), 2)} dB)."
    )


def _resample() -> tuple[list[list[float]], list[str]]:
    """The leads in PSNR by scene, and the 95 % interval of their mean when scenes are resampled with all their sets."""
    scenes: dict[str, list[float]] = {}
    for each in compute_margins(ends(), WHOLE[0]):
        scenes.setdefault(_scene(each.scene), []).append(each.lead)
    groups = list(scenes.values())
    draws = np.random.default_rng(0).integers(len(groups), size=(20000, len(groups)))
    means = [np.mean([lead for index in draw for lead in groups[index]]) for draw in draws]
    return groups, [_signed(float(np.quantile(means, q)), 1) for q in (0.025, 0.975)]


def _scene(name: str) -> str:
    return re.sub(r"_(?:first|last)12$", "", name)


def _published_alone() -> str:
    """Against InstantSplat and the paper's losses, with and without our fill."""
    rows = [row for row in ends() if row.method == OURS or row.method.startswith(("instantsplat", "paper"))]
    found = compute_margins(rows, WHOLE[0])
    return (
        f"Against the best row of InstantSplat and `paper` alone: {_signed(_mean(found), 2)} dB, better in "
        f"{len(found) - _behind(found)} of {len(found)}."
    )


def _paper() -> str:
    """What the paper's losses change of the recipe that they act on."""
    scores: dict[str, dict[tuple[str, int], list[float]]] = {"paper": {}, "instantsplat-xl": {}}
    for row in ends():
        if row.method in scores and row.psnr is not None:
            scores[row.method].setdefault((row.scene, row.views), []).append(row.psnr)
    losses, base = scores["paper"], scores["instantsplat-xl"]
    changes = [np.mean(losses[case]) - np.mean(base[case]) for case in losses if case in base]
    return (
        f"`paper` changes InstantSplat-XL, on which its losses act, by {_signed(float(np.mean(changes)), 2)} dB in the "
        f"mean of {len(changes)} sets; the publication reports a gain."
    )


def race_rivals() -> str:
    """A line for each other method: ours beside it in the mean of the cases that both have."""
    rows = []
    for method, (psnr, ssim, lpips) in sorted(_beside().items()):
        leads = [_signed(-point.lead, digits) for point, digits in ((psnr, 2), (ssim, 3), (lpips, 3))]
        time = "–" if psnr.time is None else f"{psnr.time:.1f}"
        rows.append([method, str(psnr.sets), " / ".join(leads), f"{psnr.size:.1f}", time])
    return table(("method", "sets", "lead of `balanced`: PSNR / SSIM / LPIPS", "Gaussians, times", "time, times"), rows)


def _beside() -> dict[str, tuple[race_chart.Point, ...]]:
    """By other method: it beside ours, in each measure."""
    by_measure = (race_chart.beside(ends(), measure, race_chart.times(ends())) for measure in WHOLE)
    return {each[0].method: each for each in zip(*by_measure, strict=True) if each[0].method != OURS}


def _leads(found: Sequence[Sequence[Margin]]) -> list[str]:
    """The mean lead in PSNR, SSIM and LPIPS."""
    return [_signed(_mean(each), digits) for each, digits in zip(found, (2, 3, 3), strict=True)]


def _signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "−").replace("+0.", "+.").replace("−0.", "−.")


def find_unlike_cases() -> list[str]:
    """Cases whose rows start from other cameras, as other rounding may find them where photographs hardly suffice."""
    found = []
    for case in dict.fromkeys((row.scene, row.views) for row in ends()):
        here = [row for row in ends() if (row.scene, row.views) == case and row.psnr is not None]
        focal_pct = [row.focal_error_pct for row in here if row.focal_error_pct is not None]
        spread = max(focal_pct, default=0.0) - min(focal_pct, default=0.0)
        if len({row.num_cameras for row in here}) > 1 or spread > SAME_FOCAL_PCT:
            found.append(f"{case[0]}, {case[1]}")
    return found


def _seeds() -> str:
    """By how much methods differ from seed to seed."""
    found: dict[tuple[str, str, int], list[float]] = {}
    for row in ends():
        if row.method in SEEDED and row.psnr is not None:
            found.setdefault((row.method, row.scene, row.views), []).append(row.psnr)
    several = {key: values for key, values in found.items() if len(values) > 1}
    one_seed = {(method, *ONE_SEED) for method in SEEDED if method != OURS}
    require(found.keys() - several.keys() == one_seed, "one seed on goldcape at 12 alone")
    require(all(len(values) == 3 for key, values in found.items() if key[0] == OURS), "three seeds of balanced")
    others = [len(values) for key, values in several.items() if key[0] != OURS]
    three = others.count(3) // 2
    require(others.count(2) == len(others) - 2 * three, "two or three seeds")
    apart = {
        method: [max(values) - min(values) for key, values in several.items() if key[0] == method] for method in SEEDED
    }
    between = [
        f"{median(each):.1f} dB in the median, {max(each):.1f} at most".replace("0.", ".") for each in apart.values()
    ]
    two = len(others) // 2 - three
    many = f"three on {three} sets" + (f", of two on {two}" if two else "")
    return (
        f"Seeds: `balanced` three; MCMC and a Gaussian a pixel, both with our fill, {many} and one on goldcape at 12; "
        f"the others one. From seed to seed `balanced` differs by {between[0]}; MCMC by {between[1]}; a Gaussian a "
        f"pixel by {between[2]}."
    )


def _fast() -> str:
    """What `fast` wins and loses beside the best other."""
    leads = _leads([compute_margins(ends(), measure, "fast") for measure in WHOLE])
    beside = _beside()
    times = [point.time for method in ("fast", *SEEDED[1:], LARGEST) if (point := beside[method][0]).time]
    mcmc, pixel, largest = (f"{each / times[0]:.1f}" for each in times[1:])
    return (
        f"`fast`, one seed, against the best other of each set: {leads[0]} dB, {leads[1]} SSIM, {leads[2]} LPIPS. MCMC "
        f"takes {mcmc} times its time, a Gaussian a pixel {pixel}, InstantSplat-XL {largest}."
    )


def _quality() -> str:
    """What `quality` wins and loses beside the best other."""
    found = [compute_margins(ends(), measure, "quality") for measure in WHOLE]
    leads = _leads(found)
    ahead = [sum(margin.lead >= 0 for margin in each) for each in found]
    ratio = exp(sum(log(margin.ours / margin.best) for margin in found[2]) / len(found[2])) - 1
    percent = round(100 * abs(ratio))
    by_ratio = "as good" if not percent else f"{percent} % {'worse' if ratio > 0 else 'better'}"
    return (
        f"`quality`, one seed, against the best other of each set: {leads[0]} dB, {leads[1]} SSIM, {leads[2]} LPIPS in "
        f"the mean of {len(found[0])}; no worse in {ahead[0]}, {ahead[1]} and {ahead[2]}; by ratio its LPIPS is "
        f"{by_ratio}."
    )


def headlines() -> list[tuple[str, str, str]]:
    """The rows of README's table: of the default, and of `quality`; all measures, and the sets that were refused."""
    default, quality = ([compute_margins(ends(), measure, method) for measure in WHOLE] for method in (OURS, "quality"))
    beside, (low, high) = _beside(), _resample()[1]
    more = beside["quality"][0]
    return [
        (
            f"held-out PSNR, SSIM, LPIPS on {len(default[0])} sets, partly of scenes that presets were chosen on: mean "
            "lead over the best of up to five other recipes\\* in each",
            f"{_three(default)} (PSNR {low} to {high} by scenes), with a {beside[LARGEST][0].size:.0f}th of "
            f"InstantSplat-XL's Gaussians; {_count_refused()} more sets refused",
            f"better in {_behinds(default)}",
        ),
        (
            f"the same on {len(quality[0])} of them with `--preset quality`: {more.size:.1f} times the Gaussians, "
            f"{more.time:.1f} times the time",
            _three(quality),
            f"better in {_behinds(quality)}",
        ),
    ]


def _three(found: Sequence[Sequence[Margin]]) -> str:
    psnr, ssim, lpips = _leads(found)
    return f"{psnr} dB, {ssim}, {lpips}"


def _behinds(found: Sequence[Sequence[Margin]]) -> str:
    psnr, ssim, lpips = map(_behind, found)
    return f"{psnr}, {ssim} and {lpips}"


def _behind(found: Sequence[Margin]) -> int:
    return sum(each.lead < 0 for each in found)


def _lost(found: Sequence[Margin], digits: int) -> str:
    behind = [each for each in found if each.lead < 0]
    most = f" (by {abs(min(each.lead for each in behind)):.{digits}f} at most)" if behind else ""
    return f"{len(behind)}{most}".replace("0.", ".")


def _cell(margin: Margin, digits: int) -> str:
    ours, best = part(margin.ours, digits), part(margin.best, digits)
    return f"{f'**{ours}**' if margin.lead >= 0 else ours}, {best} {margin.by}"


def _mean(found: Sequence[Margin]) -> float:
    return sum(each.lead for each in found) / len(found)


BLOCKS = (race_losses, race_rivals, race_cases)
