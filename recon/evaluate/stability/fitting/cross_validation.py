"""The verdict on each scene by numbers that were fitted without it: what the headline figures are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from splatnode.recon.evaluate.stability.fitting import bounds, odds
from splatnode.recon.evaluate.stability.fitting.judge import attach_bounds, exceeds_bounds, is_published
from splatnode.recon.evaluate.stability.fitting.samples import Sample
from splatnode.recon.evaluate.stability.windows.summary import KINDS, compute_share_within
from splatnode.recon.verification.models import VerdictModel


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
    claims = bounds.fit(samples)
    return VerdictModel(claims, odds.fit(samples, claims))


def fit_without_each_scene(samples: Sequence[Sample]) -> dict[str, VerdictModel]:
    """Fits numbers by scene, each to the samples of all other scenes."""
    scenes = dict.fromkeys(sample.scene for sample in samples)
    return {scene: fit_models([sample for sample in samples if sample.scene != scene]) for scene in scenes}


def pair_held_out_models(samples: Sequence[Sample], numbers: Mapping[str, VerdictModel]) -> list[Judgement]:
    """Each sample with the numbers that were fitted without its scene."""
    return [(sample, numbers[sample.scene]) for sample in samples]


def make_report(pairs: Sequence[Judgement]) -> dict[str, object]:
    """Reports on windows, by number of images and by scene, too, and on the matrix."""
    windows = [pair for pair in pairs if pair[0].window and not pair[0].told]
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
        "windows_told": asdict(count_judgements([pair for pair in pairs if pair[0].window and pair[0].told])),
        "matrix": asdict(count_judgements([pair for pair in pairs if not pair[0].window])),
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
