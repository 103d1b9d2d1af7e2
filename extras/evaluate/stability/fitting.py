"""The verdict on each scene by numbers that were fitted without it: what the headline figures are.

The samples are registrations with known truth, as windows.json and stability.json keep them, published or not.
"""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import lsq_linear, minimize

from splatnode.capture.process.config import record_of
from splatnode.extras.evaluate.stability.trial import ROUGH, CameraError, has_only_right_cameras, make_finite_bounds
from splatnode.extras.evaluate.stability.window_campaign import KINDS, compute_share_within
from splatnode.extras.evaluate.stability.windows import OURS, WindowRow
from splatnode.recon.result.verdict import Code
from splatnode.recon.verification import DecisionConfig
from splatnode.recon.verification.decision import LIMITS
from splatnode.recon.verification.error_model import (
    MIN_INLIER_RATIO,
    BoundModel,
    ErrorModel,
    EvidenceCase,
    OddsModel,
    Term,
    VerdictModel,
    VerdictModels,
    compute_log_odds,
    compute_measures,
)
from splatnode.recon.verification.evidence import Evidence, find_non_finite
from splatnode.recon.verification.refit import Errors

CLEAN = "clean"  # the kind of trials of lens assumptions that break nothing
GROSS_SPREAD_PCT = 20.0  # of the true centres' spread


@dataclass(frozen=True, eq=False)
class Sample:
    """One registration, with what was evidence for it and how wrong it is."""

    scene: str  # samples of one scene are left out together
    count: int  # photographs
    window: bool  # of windows.json; else of the matrix
    whole: bool  # every photograph has a camera
    stood_still: bool  # the pairs alone refused it: the camera only turned, or not even that
    evidence: Evidence
    errors: Mapping[str, CameraError]  # by camera; of those that have a true one
    broken: bool = False  # its images break what is assumed of lenses, on purpose: a trial of lens assumptions
    lens_trial: bool = False  # of `lens_assumptions`; else, without a window, of the matrix
    has_known_lens: bool = False  # what EXIF or a calibration says of the lens came with the photographs of a window

    @property
    def is_pair(self) -> bool:
        """Two cameras have numbers of their own."""
        return len(self.evidence.cameras) == 2

    @property
    def own_lens(self) -> bool:
        """Whether any image has a lens that is not what it was taken for."""
        return any(camera.own_lens for camera in self.evidence.cameras)

    @property
    def is_one_world(self) -> bool:
        """Whether all cameras are of one world; those of several are wrong whatever is claimed of them."""
        return len(self.errors) == len(self.evidence.cameras)

    @property
    def right(self) -> bool:
        return self.is_one_world and has_only_right_cameras(list(self.errors.values()))

    @property
    def is_gross(self) -> bool:
        """Wrong beyond what any claim should allow; motion where there was none is, too."""
        return not self.is_one_world or any(
            error.centre_pct is None or error.is_far or (error.spread_pct or 0.0) > GROSS_SPREAD_PCT
            for error in self.errors.values()
        )


def load_results(path: Path) -> dict[str, Any]:
    """The JSON of a file, which may be compressed (.gz)."""
    data = path.read_bytes()
    return json.loads(gzip.decompress(data) if path.suffix == ".gz" else data)


def read_samples(paths: list[Path]) -> list[Sample]:
    """All samples. Raises ValueError for a file that is neither of the two."""
    found = []
    for path in paths:
        content = load_results(path)
        if "rows" in content:
            rows = record_of(content["rows"], list[WindowRow])
            has_known_lens = content.get("told", "nothing") != "nothing"
            windows = (make_window_sample(row) for row in rows if row.method == OURS and row.evidence is not None)
            found += [replace(window, has_known_lens=has_known_lens) for window in windows]
        elif "trials" in content:
            found += list(make_trial_samples(content["trials"]))
        else:
            raise ValueError(f"{path} must be a windows.json or a stability.json, it has {', '.join(content)}")
    return found


def make_window_sample(row: WindowRow) -> Sample:
    """The sample of a row that has evidence."""
    evidence = _parse_evidence(dict(row.evidence or {}))
    whole = len(evidence.cameras) == row.count
    errors = {error.name: error for error in row.cameras}
    return Sample(row.scene, row.count, True, whole, _is_still(row.published, row.verdict), evidence, errors)


def make_trial_samples(trials: list[dict]) -> Iterator[Sample]:
    """Yields the sample of each trial of ours that has evidence."""
    for trial in trials:
        if trial["method"] == OURS and trial.get("evidence") is not None:
            evidence = _parse_evidence(trial["evidence"])
            scene = trial["note"].split(",")[0].split(" and ")[0]
            still, errors = _is_still(trial["published"], trial["verdict"]), _parse_errors(trial["errors"])
            kind = {"broken": _is_broken(trial), "lens_trial": "kind" in trial}
            yield Sample(scene, len(evidence.cameras), False, True, still, evidence, errors, **kind)


def _is_broken(trial: dict) -> bool:
    return trial.get("kind", CLEAN) != CLEAN


def _is_still(published: bool, verdict: str) -> bool:
    return not published and verdict in (Code.NO_PARALLAX.value, Code.STATIC_CAMERA.value)


def _parse_errors(records: list[dict]) -> dict[str, CameraError]:
    return {record["name"]: record_of(record, CameraError) for record in records}


def _parse_evidence(record: dict[str, Any]) -> Evidence:
    """The evidence of a report, in which None stands for a number that was not finite."""
    return record_of({name: _replace_none(value) for name, value in record.items() if name != "log_odds"}, Evidence)


def _replace_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _replace_none(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_replace_none(each) for each in value]
    return math.nan if value is None else value


# What the verdict would be of a sample under other numbers, by the checks that ask the evidence alone.


def judge_sample(sample: Sample, numbers: VerdictModel) -> EvidenceCase:
    return EvidenceCase(sample.evidence, DecisionConfig(), numbers)


def passes_limits(sample: Sample, numbers: VerdictModel) -> bool:
    """Whether nothing refuses it but the odds."""
    case = judge_sample(sample, numbers)
    if sample.stood_still:
        return False
    finite = not any(find_non_finite(sample.evidence))
    return finite and all(check(case) is None for check in LIMITS) and case.is_usable


def is_published(sample: Sample, numbers: VerdictModel) -> bool:
    odds = compute_log_odds(sample.evidence, numbers.claims, numbers.odds)
    return odds.total >= DecisionConfig().min_log_odds and passes_limits(sample, numbers)


def is_wrong(sample: Sample, numbers: VerdictModel) -> bool:
    """Grossly wrong; or not right, and beyond the claim."""
    return sample.is_gross or (not sample.right and exceeds_bounds(sample, numbers))


def exceeds_bounds(sample: Sample, numbers: VerdictModel) -> bool:
    """Beyond 2.5 times a bound; or beyond 5 degrees or 10 % of the distance, and said to be exact."""
    rough = not judge_sample(sample, numbers).is_exact
    return not sample.is_one_world or any(error.is_wrong(rough) for error in attach_bounds(sample, numbers))


def attach_bounds(sample: Sample, numbers: VerdictModel) -> tuple[CameraError, ...]:
    """The errors, each beside the bounds that these numbers give its camera."""
    bounds = judge_sample(sample, numbers).bounds
    return tuple(replace(error, bounds=make_finite_bounds(bounds[name])) for name, error in sample.errors.items())


# The models of the 95 % bounds: a line between the logarithms of what the sources say and of the errors found.

Array = npt.NDArray[np.float64]

# Of the errors that are fitted: more than the 95 % that are claimed, so that bounds hold scene by scene, on others, too
QUANTILE = 0.96
RIDGE = 1e-3  # penalty of squared powers, for each camera: where two sources say the same, both count alike
MIN_OWN_LENSES = 50  # cameras of sets with own lenses, from which on they have a factor of their own
# Largest such factor: with more, all of these sets would be called rough for the few in which one more lens went unseen
MAX_OWN_LENS = 4.0
NEGLIGIBLE = 1e-6  # a smaller power is 0
# Errors are not told from these: true cameras are no better known. Degrees, of the distance, of log focal.
FLOORS = {"rotation": 0.1, "centre": 2e-4, "focal": 2e-3}


@dataclass(frozen=True)
class _ErrorSample:
    """One camera's error and what was said of it."""

    scene: str
    error: float
    errors: Errors
    inlier_ratio: float
    link: float
    count: int
    own_lens: bool  # of any camera of its set
    broken: bool  # what its set takes for granted of lenses, on purpose


def fit_bounds(samples: Sequence[Sample]) -> ErrorModel:
    """From registrations that are not grossly wrong, each scene with the square root of its number of cameras.

    Sets that break what is assumed of lenses say how much wider bounds are where an image has a lens of its own, and
    nothing else: where nothing tells that they do, they look like any other.
    """
    usable = [sample for sample in samples if not sample.is_gross and (sample.own_lens or not sample.broken)]
    return ErrorModel(
        rotation=_fit_bound_model(_collect_samples(usable, "rotation"), FLOORS["rotation"]),
        centre=_fit_bound_model(_collect_samples(usable, "centre"), FLOORS["centre"], link=True),
        focal=_fit_bound_model(_collect_samples(usable, "focal"), FLOORS["focal"], profile=True),
    )


def _collect_samples(samples: Sequence[Sample], kind: str) -> list[_ErrorSample]:
    lines = []
    for sample in samples:
        count, link = len(sample.evidence.cameras), sample.evidence.weakest_link.inlier_ratio
        of_set = link, count, sample.own_lens, sample.broken
        for camera in sample.evidence.cameras:
            found = sample.errors[camera.name]
            if kind == "rotation":
                sizes = found.rotation_deg, camera.errors.rotation
                lines.append(_ErrorSample(sample.scene, *sizes, camera.inlier_ratio, *of_set))
            elif kind == "centre":
                centre = (found.centre_pct or 0.0) / 100.0
                lines.append(_ErrorSample(sample.scene, centre, camera.errors.centre, camera.inlier_ratio, *of_set))
            else:
                focal = float(np.abs(np.log1p(max(found.focal_pct, -99.0) / 100.0)))
                lines.append(_ErrorSample(sample.scene, focal, camera.focal, 1.0, 1.0, *of_set[1:]))
    return lines


def _fit_bound_model(
    lines: Sequence[_ErrorSample], floor: float, profile: bool = False, link: bool = False
) -> BoundModel:
    """The powers, then the quantile of what is left.

    More of a source never narrows a bound, and more explained matches never widen it. The profile counts if `profile`
    (it bounds rotations and centres from below as it is), the weakest link if `link`.
    """
    whole = lines
    lines = [line for line in whole if not line.broken]
    scenes = np.array([line.scene for line in lines])
    weights = np.array([1.0 / np.sqrt((scenes == scene).sum()) for scene in scenes])
    wanted = np.log(np.hypot([line.error for line in lines], floor / 3.0))
    varies = len({line.count for line in lines}) > 1
    used = {"sigma": True, "regions": True, "profile": profile, "inlier_ratio": True, "link": link, "count": varies}
    columns = np.array([_compute_logarithms(line, floor) for line in lines])
    columns = columns * np.array([float(each) for each in used.values()])
    design = np.column_stack([np.ones(len(lines)), columns])
    least = np.array([-np.inf, 0.0, 0.0, 0.0, -np.inf, -np.inf, -np.inf])
    most = np.array([np.inf, np.inf, np.inf, np.inf, 0.0, 0.0, np.inf])
    root = np.sqrt(weights)
    ridge = np.sqrt(RIDGE * weights.sum()) * np.eye(design.shape[1])
    ridge[0] = 0.0  # of the powers, not of the factor
    powers = lsq_linear(
        np.vstack([design * root[:, None], ridge]), np.concatenate([wanted * root, np.zeros(len(ridge))]), (least, most)
    ).x
    powers[1:][~np.array(list(used.values()))] = 0.0
    powers = np.where(np.abs(powers) < NEGLIGIBLE, 0.0, powers)
    left, own = wanted - design @ powers, np.array([line.own_lens for line in lines])
    of_common = _quantile(left[~own], weights[~own], QUANTILE)
    found = dict(zip(used, powers[1:], strict=True))
    found |= {"factor": np.exp(powers[0] + of_common), "floor": floor}
    mixed = [line for line in whole if line.own_lens]
    if len(mixed) >= MIN_OWN_LENSES:
        columns = np.array([_compute_logarithms(line, floor) for line in mixed]) * np.array(
            [float(each) for each in used.values()]
        )
        errors = np.log(np.hypot([line.error for line in mixed], floor / 3.0))
        beyond = errors - np.column_stack([np.ones(len(mixed)), columns]) @ powers
        wider = np.exp(_quantile(beyond, np.ones(len(mixed)), QUANTILE) - of_common)
        found["own_lens"] = float(np.clip(wider, 1.0, MAX_OWN_LENS))
    return BoundModel(**{name: float(f"{number:.3g}") for name, number in found.items()})


def _compute_logarithms(line: _ErrorSample, floor: float) -> list[float]:
    sources = (line.errors.sigma, line.errors.regions, line.errors.profile)
    shares = (_log_share(line.inlier_ratio), _log_share(line.link))
    return [*(float(np.log(np.hypot(each, floor))) for each in sources), *shares, float(np.log(line.count))]


def _log_share(inlier_ratio: float) -> float:
    return float(np.log(max(inlier_ratio, MIN_INLIER_RATIO)))


def _quantile(values: Array, weights: Array, share: float) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order]) / weights.sum()
    return float(values[order][min(int(np.searchsorted(below, share)), len(values) - 1)])


# The odds: a logistic regression of right against wrong, whose slopes have the sign that their measure must have.


# Of the slopes: whether more of a measure speaks for the poses, or against them.
FOR = (
    "inlier_ratio",
    "camera_inlier_ratio",
    "link_inlier_ratio",
    "coverage",
)
AGAINST = ("flat_patch", "reflection", "directions", "rotation_bound", "travel_bound")
SIGNS = {**dict.fromkeys(FOR, 1), **dict.fromkeys(AGAINST, -1)}
WRONG_WEIGHT = 4.0  # of a wrong registration beside a right one: there are fewer, and each counts more
ODDS_RIDGE = 0.02  # penalty of squared slopes (in standard deviations), for each registration and slope
MARGIN = 0.5  # nats by which the best wrong registration stays refused: others are made elsewhere


def fit_odds(samples: Sequence[Sample], claim_model: ErrorModel) -> OddsModel:
    """The prior is such that no registration beyond its claim is published whose scene was left out when it was judged.

    So is what a lens of its own counts, with the sets that break what is assumed of lenses: where an image has one,
    more must speak for the poses. Sets that break it and do not show it look like any other, and set no prior.
    """
    claims_alone = VerdictModel(claim_model, OddsModel(0.0, {}))
    known = [sample for sample in samples if sample.right or is_wrong(sample, claims_alone)]
    known = [sample for sample in known if sample.own_lens or not sample.broken]
    table = np.array([[compute_measures(sample.evidence, claim_model)[name] for name in SIGNS] for sample in known])
    right = np.array([sample.right for sample in known])
    scenes = np.array([sample.scene for sample in known])
    limits = np.array([passes_limits(sample, claims_alone) for sample in known])
    beyond = np.array([exceeds_bounds(sample, claims_alone) for sample in known])
    own, broken = (np.array([getattr(sample, name) for sample in known]) for name in ("own_lens", "broken"))
    left_out = np.zeros(len(known))
    for scene in np.unique(scenes):
        rest = (scenes != scene) & ~broken
        left_out[scenes == scene] = _compute_log_odds(_fit_regression(table[rest], right[rest]), table[scenes == scene])
    whole = _fit_regression(table[~broken], right[~broken])
    doubted = ~right & limits & beyond
    lower = _compute_offset(left_out[doubted & ~own])
    of_own = max(0.0, _compute_offset(left_out[doubted & own]) - lower)
    terms = {**whole.terms, "own_lens": Term(0.0, -float(f"{of_own:.3g}"))}
    return OddsModel(float(f"{whole.prior - lower:.3g}"), terms)


def _compute_offset(doubted: Array) -> float:
    """Returns by how much log odds must be lowered for none of these to be published."""
    return max(0.0, float(doubted.max()) + MARGIN - DecisionConfig().min_log_odds) if len(doubted) else 0.0


def _fit_regression(table: Array, right: npt.NDArray[np.bool_]) -> OddsModel:
    names = list(SIGNS)
    typical, scale = table[right].mean(0), table.std(0) + 1e-9
    design = np.column_stack([np.ones(len(table)), (table - typical) / scale])
    weights = np.where(right, 1.0, WRONG_WEIGHT)
    target = right.astype(np.float64)

    def loss(slopes: Array) -> tuple[float, Array]:
        total = design @ slopes
        penalty = ODDS_RIDGE * len(table) / len(names)
        value = float((weights * (np.logaddexp(0.0, total) - target * total)).sum() + penalty * (slopes[1:] ** 2).sum())
        gradient = design.T @ (weights * (1.0 / (1.0 + np.exp(-total)) - target))
        gradient[1:] += 2.0 * penalty * slopes[1:]
        return value, gradient

    limits = [(None, None), *((0.0, None) if SIGNS[name] > 0 else (None, 0.0) for name in names)]
    found = minimize(loss, np.zeros(1 + len(names)), jac=True, method="L-BFGS-B", bounds=limits).x
    terms = {
        name: Term(float(f"{typical[k]:.3g}"), float(f"{found[1 + k] / scale[k]:.3g}")) for k, name in enumerate(names)
    }
    return OddsModel(float(found[0]), terms)


def _compute_log_odds(model: OddsModel, table: Array) -> Array:
    """(M,) log odds of rows of measures (M, T), in the order of the terms."""
    typical = np.array([term.typical for term in model.terms.values()])
    return model.prior + (table - typical) @ np.array([term.slope for term in model.terms.values()])


@dataclass(frozen=True)
class JudgementCounts:
    """The counts of registrations: right, of these published; published, of these beyond; and coverage."""

    sets: int
    right: int
    right_published: int
    published: int
    beyond: int
    cameras: int  # published
    rotations_within: float | None  # share within the 95 % bound
    centres_within: float | None
    focals_within: float | None


Judgement = tuple[Sample, VerdictModel]


def fit_models(samples: Sequence[Sample]) -> VerdictModel:
    claims = fit_bounds(samples)
    return VerdictModel(claims, fit_odds(samples, claims))


def fit_without_each_scene(samples: Sequence[Sample]) -> dict[str, VerdictModel]:
    """Fits numbers by scene, each to the samples of all other scenes."""
    scenes = dict.fromkeys(sample.scene for sample in samples)
    return {scene: fit_models([sample for sample in samples if sample.scene != scene]) for scene in scenes}


def pair_held_out_models(samples: Sequence[Sample], numbers: Mapping[str, VerdictModel]) -> list[Judgement]:
    """Each sample with the numbers that were fitted without its scene."""
    return [(sample, numbers[sample.scene]) for sample in samples]


def make_report(pairs: Sequence[Judgement]) -> dict[str, object]:
    """Reports on windows, by number of images and by scene, too, and on the matrix."""
    windows = [pair for pair in pairs if pair[0].window and not pair[0].has_known_lens]
    by_scene = {
        scene: asdict(count_judgements([pair for pair in pairs if pair[0].window and pair[0].scene == scene]))
        for scene in sorted({sample.scene for sample, _ in windows})
    }
    by_count = {
        str(count): asdict(count_judgements([pair for pair in windows if pair[0].count == count]))
        for count in sorted({sample.count for sample, _ in windows})
    }
    right = [(s, numbers) for s, numbers in windows if s.right]
    return {
        "windows": asdict(count_judgements(windows)),
        "windows_by_count": by_count,
        "windows_by_scene": by_scene,
        "windows_told": asdict(count_judgements([pair for pair in pairs if pair[0].window and pair[0].has_known_lens])),
        "matrix": asdict(count_judgements([each for each in pairs if not each[0].window and not each[0].lens_trial])),
        "beyond": [identify_sample(sample) for sample, numbers in pairs if _exceeds_published_bounds(sample, numbers)],
        "right_refused": [identify_sample(s) for s, numbers in right if not is_published(s, numbers)],
    }


def count_judgements(pairs: Sequence[Judgement]) -> JudgementCounts:
    out = [(sample, numbers) for sample, numbers in pairs if is_published(sample, numbers)]
    errors = [error for sample, numbers in out for error in attach_bounds(sample, numbers)]
    shares = {
        kind: compute_share_within([error.pair_with_bounds()[kind] for error in errors if error.pair_with_bounds()])
        for kind in KINDS
    }
    return JudgementCounts(
        sets=len(pairs),
        right=sum(sample.right for sample, _ in pairs),
        right_published=sum(sample.right for sample, _ in out),
        published=len(out),
        beyond=sum(exceeds_bounds(sample, numbers) for sample, numbers in out),
        cameras=len(errors),
        rotations_within=shares["rotation"],
        centres_within=shares["centre"],
        focals_within=shares["focal"],
    )


def identify_sample(sample: Sample) -> Mapping[str, object]:
    """Enough to find it in the raw results."""
    errors = list(sample.errors.values())
    return {
        "scene": sample.scene,
        "names": [camera.name for camera in sample.evidence.cameras],
        "rotation_deg": max((error.rotation_deg for error in errors), default=None),
        "centre_pct": max((error.centre_pct or 0.0 for error in errors), default=None),
        "together": sample.is_one_world,
    }


def _exceeds_published_bounds(sample: Sample, numbers: VerdictModel) -> bool:
    return is_published(sample, numbers) and exceeds_bounds(sample, numbers)


# Rows of windows.json under numbers that were fitted without their scene: what the published figures count.

REFUSED = Code.AMBIGUOUS.value  # stands for whatever the verdict would have said


def rejudge_rows(rows: Sequence[WindowRow], numbers: Mapping[str, VerdictModel]) -> list[WindowRow]:
    """`numbers` by the scene that they were fitted without; rows of which nothing was registered stay as they are."""
    return [_rejudge_row(row, make_window_sample(row), numbers) if row.evidence is not None else row for row in rows]


def _rejudge_row(row: WindowRow, sample: Sample, by_scene: Mapping[str, VerdictModel]) -> WindowRow:
    if sample.is_pair or row.scene not in by_scene:
        return row
    numbers = by_scene[row.scene]
    exact, cameras = judge_sample(sample, numbers).is_exact, attach_bounds(sample, numbers)
    if is_published(sample, numbers):
        verdict = (Code.OK.value if sample.whole else Code.OK_PARTIAL.value) if exact else ROUGH
        return replace(row, published=True, verdict=verdict, cameras=cameras)
    return replace(row, published=False, verdict=REFUSED if row.published else row.verdict, cameras=cameras)


# The fitted numbers as the Python module recon/verification/fitted.py.

HEAD = '''"""The numbers of the verdict. Written by `python -m tests.bench fit`; do not edit."""

from __future__ import annotations

from splatnode.recon.verification.error_model import BoundModel, ErrorModel
from splatnode.recon.verification.error_model import OddsModel, Term
from splatnode.recon.verification.error_model import VerdictModels, VerdictModel

'''


def format_module(numbers: VerdictModels) -> str:
    return HEAD + "\n".join(
        ["FITTED = VerdictModels(", *_format_model("many", numbers.many), *_format_model("pair", numbers.pair), ")", ""]
    )


def _format_model(name: str, numbers: VerdictModel) -> list[str]:
    bounds = [f"            {f.name}={_format_call(getattr(numbers.claims, f.name))}," for f in fields(numbers.claims)]
    terms = [f'                "{name}": {_format_call(term)},' for name, term in numbers.odds.terms.items()]
    return [
        f"    {name}=VerdictModel(",
        "        claims=ErrorModel(",
        *bounds,
        "        ),",
        "        odds=OddsModel(",
        f"            prior={numbers.odds.prior!r},",
        "            terms={",
        *terms,
        "            },",
        "        ),",
        "    ),",
    ]


def _format_call(record: BoundModel | Term) -> str:
    """The record as Python, in one line."""
    numbers = ", ".join(f"{field.name}={getattr(record, field.name)!r}" for field in fields(record))
    return f"{type(record).__name__}({numbers})"
