"""The verdict on each scene by numbers that were fitted without it: what the headline figures are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from splatnode.recon.evaluate.stability.fitting import bounds, odds
from splatnode.recon.evaluate.stability.fitting.judge import beyond_claim, claimed, published
from splatnode.recon.evaluate.stability.fitting.samples import Sample
from splatnode.recon.evaluate.stability.windows.summary import KINDS, within
from splatnode.recon.verification.models import Numbers


@dataclass(frozen=True)
class Counts:
    """Of registrations: own cameras right, of these published; published, of these beyond the claim; and coverage."""

    sets: int
    right: int
    right_published: int
    published: int
    beyond: int
    cameras: int  # published
    rotations_within: float | None  # share within the 95 % bound
    centres_within: float | None
    focals_within: float | None


Judgement = tuple[Sample, Numbers]


def fitted(samples: Sequence[Sample]) -> Numbers:
    claims = bounds.fit(samples)
    return Numbers(claims, odds.fit(samples, claims))


def without_each_scene(samples: Sequence[Sample]) -> dict[str, Numbers]:
    """By scene, the numbers that the samples of all other scenes give."""
    scenes = dict.fromkeys(sample.scene for sample in samples)
    return {scene: fitted([sample for sample in samples if sample.scene != scene]) for scene in scenes}


def left_out(samples: Sequence[Sample], numbers: Mapping[str, Numbers]) -> list[Judgement]:
    """Each sample with the numbers that were fitted without its scene."""
    return [(sample, numbers[sample.scene]) for sample in samples]


def report(pairs: Sequence[Judgement]) -> dict[str, object]:
    """Of windows and of the matrix; of windows by their count of photographs and by scene, too."""
    windows = [pair for pair in pairs if pair[0].window and not pair[0].told]
    by_scene = {
        scene: asdict(counts([pair for pair in pairs if pair[0].window and pair[0].scene == scene]))
        for scene in sorted({sample.scene for sample, _ in windows})
    }
    by_count = {
        str(count): asdict(counts([pair for pair in windows if pair[0].count == count]))
        for count in sorted({sample.count for sample, _ in windows})
    }
    right = [(s, numbers) for s, numbers in windows if s.right]
    return {
        "windows": asdict(counts(windows)),
        "windows_by_count": by_count,
        "windows_by_scene": by_scene,
        "windows_told": asdict(counts([pair for pair in pairs if pair[0].window and pair[0].told])),
        "matrix": asdict(counts([pair for pair in pairs if not pair[0].window])),
        "beyond": [named(sample) for sample, numbers in pairs if _beyond(sample, numbers)],
        "right_refused": [named(s) for s, numbers in right if not published(s, numbers)],
    }


def counts(pairs: Sequence[Judgement]) -> Counts:
    out = [(sample, numbers) for sample, numbers in pairs if published(sample, numbers)]
    errors = [error for sample, numbers in out for error in claimed(sample, numbers)]
    shares = {kind: within([error.claimed()[kind] for error in errors if error.claimed()]) for kind in KINDS}
    return Counts(
        sets=len(pairs),
        right=sum(sample.right for sample, _ in pairs),
        right_published=sum(sample.right for sample, _ in out),
        published=len(out),
        beyond=sum(beyond_claim(sample, numbers) for sample, numbers in out),
        cameras=len(errors),
        rotations_within=shares["rotation"],
        centres_within=shares["centre"],
        focals_within=shares["focal"],
    )


def named(sample: Sample) -> Mapping[str, object]:
    """Enough to find it in the raw results."""
    errors = list(sample.errors.values())
    return {
        "scene": sample.scene,
        "names": [camera.name for camera in sample.evidence.cameras],
        "rotation_deg": max((error.rotation_deg for error in errors), default=None),
        "centre_pct": max((error.centre_pct or 0.0 for error in errors), default=None),
        "together": sample.together,
    }


def _beyond(sample: Sample, numbers: Numbers) -> bool:
    return published(sample, numbers) and beyond_claim(sample, numbers)
