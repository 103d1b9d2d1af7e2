"""What docs/measurement.md says of the race, from its raw numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from math import exp, log, sqrt
from pathlib import Path
from statistics import median

from splatnode.recon.evaluate.protocol import Row
from splatnode.recon.evaluate.report import OURS, SHOWN, WHOLE, Margin, compute_margins, read_bench
from tests.bench.quality import race_chart

RAW = Path(__file__).parents[1] / "bench" / "results" / "race.json"
DIGITS = (1, 3, 3)
SAME_FOCAL_PCT = 1.0  # by which the errors of the focal length may differ between rows of a case
LARGEST = "instantsplat-xl+fill"  # the method whose number of Gaussians is told
SEEDED = (OURS, "mcmc+fill", "pixel+fill")  # the methods of three seeds
ONE_SEED = ("goldcape", 12)  # where those of others have one


def ends() -> list[Row]:
    return [row for row in read_bench(RAW).rows if row.final]


def lines() -> list[str]:
    """A line of the table for each case; those that were refused are told with their verdict."""
    by_measure = [{(each.scene, each.views): each for each in compute_margins(ends(), measure)} for measure in WHOLE]
    found = []
    ours = [row for row in ends() if row.method == OURS]
    for case, row in {(row.scene, row.views): row for row in ours}.items():
        if row.psnr is None:
            found.append(f"| {row.scene}, {row.views} | refused: {row.verdict} | – | – | – | – | – |")
            continue
        cells = [_cells(by_case[case], digits) for by_case, digits in zip(by_measure, DIGITS, strict=True)]
        found.append(f"| {row.scene}, {row.views} | {' | '.join(cells)} |")
    return found


def summary() -> str:
    """What is lost, then what is won."""
    whole, shown = ([compute_margins(ends(), measure) for measure in measures] for measures in (WHOLE, SHOWN))
    lost = [_lost(each, digits) for each, digits in zip(whole, DIGITS, strict=True)]
    means, seen = _leads(whole), _leads(shown)
    sizes = _beside()[LARGEST][0].size
    return (
        f"Of {len(whole[0])} cases that were published, `{OURS}` is behind the best other in PSNR in {lost[0]}, "
        f"in SSIM in {lost[1]}, in LPIPS in {lost[2]}. Its mean lead is {means[0]} dB, {means[1]} in SSIM and "
        f"{means[2]} in LPIPS (positive is better); on the pixels that a training photograph shows "
        f"{seen[0]} dB, {seen[1]} and {seen[2]}. InstantSplat-XL has {sizes:.0f} times as many Gaussians."
    )


def certain() -> str:
    """How much of the leads is the seeds' chance, from the cases where the best other has several, too."""
    whole = [compute_margins(ends(), measure) for measure in WHOLE]
    known = [[(each.lead, each.error) for each in found if each.error is not None] for found in whole]
    errors = [
        f"{sqrt(sum(error**2 for _, error in found) / len(found) / len(every)):.{digits}f}".replace("0.", ".")
        for found, every, digits in zip(known, whole, (2, 4, 4), strict=True)
    ]
    beyond = sum(abs(lead) > 2 * error for lead, error in known[0])
    return (
        f"The standard error that seeds leave in these means is {errors[0]} dB, {errors[1]} and {errors[2]}; "
        f"in {beyond} of the {len(known[0])} cases whose best other has several seeds, too, the lead or the loss in "
        "PSNR is more than two of its standard errors."
    )


def against() -> list[str]:
    """A line for each other method: ours beside it in the mean of the cases that both have."""
    found = []
    for method, (psnr, ssim, lpips) in sorted(_beside().items()):
        leads = [_signed(-point.lead, digits) for point, digits in ((psnr, 2), (ssim, 3), (lpips, 3))]
        time = "not measured" if psnr.time is None else f"{psnr.time:.1f}"
        found.append(f"| {method} | {psnr.sets} | {' | '.join(leads)} | {psnr.size:.1f} | {time} |")
    return found


def _beside() -> dict[str, tuple[race_chart.Point, ...]]:
    """By other method: it beside ours, in each measure."""
    by_measure = (race_chart.beside(ends(), measure, race_chart.times(ends())) for measure in WHOLE)
    return {each[0].method: each for each in zip(*by_measure, strict=True) if each[0].method != OURS}


def _leads(found: Sequence[Sequence[Margin]]) -> list[str]:
    """The mean lead in PSNR, SSIM and LPIPS."""
    return [_signed(_mean(each), digits) for each, digits in zip(found, (2, 3, 3), strict=True)]


def _signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "−").replace("+0.", "+.").replace("−0.", "−.")


def unlike() -> list[str]:
    """Cases whose rows start from other cameras, as other rounding may find them where photographs hardly suffice."""
    found = []
    for case in dict.fromkeys((row.scene, row.views) for row in ends()):
        here = [row for row in ends() if (row.scene, row.views) == case and row.psnr is not None]
        focal_pct = [row.focal_error_pct for row in here if row.focal_error_pct is not None]
        spread = max(focal_pct, default=0.0) - min(focal_pct, default=0.0)
        if len({row.num_cameras for row in here}) > 1 or spread > SAME_FOCAL_PCT:
            found.append(f"{case[0]}, {case[1]}")
    return found


def seeds() -> str:
    """By how much methods differ from seed to seed."""
    found: dict[tuple[str, str, int], list[float]] = {}
    for row in ends():
        if row.method in SEEDED and row.psnr is not None:
            found.setdefault((row.method, row.scene, row.views), []).append(row.psnr)
    several = {key: values for key, values in found.items() if len(values) > 1}
    assert found.keys() - several.keys() == {(method, *ONE_SEED) for method in SEEDED if method != OURS}
    assert all(len(values) == 3 for key, values in found.items() if key[0] == OURS)
    others = [len(values) for key, values in several.items() if key[0] != OURS]
    three = others.count(3) // 2
    assert others.count(2) == len(others) - 2 * three
    apart = {
        method: [max(values) - min(values) for key, values in several.items() if key[0] == method] for method in SEEDED
    }
    between = [
        f"{median(each):.1f} dB in the median, {max(each):.1f} at most".replace("0.", ".") for each in apart.values()
    ]
    two = len(others) // 2 - three
    many = f"three on {three} sets" + (f", of two on {two}" if two else "")
    return (
        f"Of `balanced` it is the mean of three seeds; of MCMC and of a Gaussian a pixel, with our background, of "
        f"{many} and of one on goldcape at 12; the others have one (`race.json`). From seed to seed `balanced` differs "
        f"by {between[0]}; MCMC by {between[1]}; a Gaussian a pixel by {between[2]}"
    )


def quick() -> str:
    """What `fast` wins and loses beside the best other."""
    leads = _leads([compute_margins(ends(), measure, "fast") for measure in WHOLE])
    beside = _beside()
    times = [point.time for method in ("fast", *SEEDED[1:], LARGEST) if (point := beside[method][0]).time]
    mcmc, pixel, largest = (f"{each / times[0]:.1f}" for each in times[1:])
    return (
        f"Beside the best other in each case, `fast`, of one seed, has {leads[0]} dB, {leads[1]} in SSIM and "
        f"{leads[2]} in LPIPS in the mean (positive is better). MCMC takes {mcmc} times its time, a Gaussian a pixel "
        f"{pixel}, InstantSplat-XL {largest}"
    )


def thorough() -> str:
    """What `quality` wins and loses beside the best other."""
    found = [compute_margins(ends(), measure, "quality") for measure in WHOLE]
    leads = _leads(found)
    ahead = [sum(margin.lead >= 0 for margin in each) for each in found]
    ratio = exp(sum(log(margin.ours / margin.best) for margin in found[2]) / len(found[2])) - 1
    percent = round(100 * abs(ratio))
    by_ratio = "as good" if not percent else f"{percent} % {'worse' if ratio > 0 else 'better'}"
    return (
        f"`quality`, of one seed, leads the best other by {leads[0]} dB, {leads[1]} in SSIM and {leads[2]} in LPIPS in "
        f"the mean of {len(found[0])} sets (positive is better), and is no worse in {ahead[0]}, {ahead[1]} and "
        f"{ahead[2]}; by ratio its LPIPS is {by_ratio}"
    )


def headlines() -> list[str]:
    """The lines of the README's table: of the default, and of `quality`."""
    beside, found, best = _beside(), compute_margins(ends(), WHOLE[0]), compute_margins(ends(), WHOLE[0], "quality")
    quality = beside["quality"][0]
    share = f"a {beside[LARGEST][0].size:.0f}th of InstantSplat-XL's Gaussians"
    return [
        f"| held-out PSNR on {len(found)} sets that nothing was tuned on, "
        "against the best of up to five other recipes\\* in each "
        f"| {_won(found)} in the mean, with {share} | better in {_behind(found)} |",
        f"| the same on {len(best)} of them with `--preset quality`: {quality.size:.1f} times the Gaussians, "
        f"{quality.time:.1f} times the time "
        f"| {_won(best)} in the mean | better in {_behind(best)} |",
    ]


def _won(found: Sequence[Margin]) -> str:
    return f"better in {len(found) - _behind(found)}; {_signed(_mean(found), 2)} dB"


def _behind(found: Sequence[Margin]) -> int:
    return sum(each.lead < 0 for each in found)


def _lost(found: Sequence[Margin], digits: int) -> str:
    behind = [each for each in found if each.lead < 0]
    most = f" (by {abs(min(each.lead for each in behind)):.{digits}f} at most)" if behind else ""
    return f"{len(behind)}{most}".replace("0.", ".")


def _cells(margin: Margin, digits: int) -> str:
    ours, best = (re.sub(r"^0\.", ".", f"{value:.{digits}f}") for value in (margin.ours, margin.best))
    return f"{f'**{ours}**' if margin.lead >= 0 else ours} | {best} {margin.by}"


def _mean(found: Sequence[Margin]) -> float:
    return sum(each.lead for each in found) / len(found)
