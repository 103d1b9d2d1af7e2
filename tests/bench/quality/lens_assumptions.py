"""Images that break what is assumed of lenses: `python -m tests.bench lens_assumptions SCENE ... --out FILE`.

For each scene, number of images (3, 6, 12), kind of `extras/evaluate/stability/degradations.py` and setting
(nothing told, EXIF right and unchanged, lens given for all), cameras and verdict are estimated from a window that
overlaps well, and compared with the truth. Wrong is a camera beyond 2.5 times a bound, or beyond 5 degrees or 10 % of
the distance without the word rough. A trial counts as answered where it is published and not wrong.

`--judge FILE --fitted-to RESULT ...` runs nothing: it judges the trials of FILE by numbers that are fitted to the
samples of the results (those of `python -m tests.bench fit`) without the trial's scene, in a minute.
"""

from __future__ import annotations

import argparse
import json
import time
import zlib
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from splatnode.extras.evaluate.dataset import load_scene
from splatnode.extras.evaluate.stability.degradations import (
    COUNTS,
    KINDS,
    LATER_KINDS,
    SETTINGS,
    AssumptionBreak,
    set_intrinsics,
)
from splatnode.extras.evaluate.stability.fitting import (
    Sample,
    exceeds_bounds,
    fit_models,
    is_published,
    load_results,
    make_trial_samples,
    read_samples,
)
from splatnode.extras.evaluate.stability.perturbations import (
    TrialImage,
    TrialScene,
    find_neighbour_sets,
    find_parallel_sets,
)
from splatnode.extras.evaluate.stability.trial import (
    ROUGH,
    CameraError,
    ensure_registration,
    list_registered_cameras,
    make_frames,
    make_world,
    score_cameras,
)
from splatnode.extras.evaluate.stability.windows import (
    OURS,
    PieceKey,
    load_plain_features,
    match_keyframes,
    select_keys,
)
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import estimate_cameras, load_prior, prepare
from splatnode.recon.fallbacks import run_fallbacks
from splatnode.recon.keyframes import screen_all
from splatnode.recon.matching.view_graph import mask_moving_objects
from splatnode.recon.verification.error_model import VerdictModel

STEP_DEG = 12.0
_ALL_KINDS = {**KINDS, **LATER_KINDS}


@dataclass(frozen=True)
class Trial:
    """One line of the result. Ratios are errors over bounds, the largest of all cameras; None without an answer."""

    scene: str
    count: int
    kind: str
    setting: str
    verdict: str
    published: bool
    wrong: bool
    right: bool  # every camera within 2 degrees and 5 % of the spread, published or not
    num_cameras: int
    rotation_ratio: float | None
    centre_ratio: float | None
    focal_ratio: float | None
    rotation_bound_deg: float | None  # medians over the cameras
    centre_bound_percent: float | None
    focal_bound_percent: float | None
    worst: str | None
    seconds: float
    message: str
    # As a trial of the stability matrix has them, for `python -m tests.bench fit`
    method: str
    note: str
    errors: tuple[CameraError, ...]  # of the published cameras; of a refusal, of those that were registered
    evidence: Mapping[str, object] | None
    draw: int = 0  # of the window


def window(place: TrialScene, count: int, draw: int = 0) -> list[TrialImage]:
    """Consecutive photographs that overlap well; the same in every run of a `draw`. Empty where a scene has too few."""
    starts, stride = find_neighbour_sets(place.Ts_world_camera, count, STEP_DEG)
    if not starts:
        starts, stride = find_parallel_sets(place.Ts_world_camera, count)
    if not starts:
        stride = max(1, min(2, (len(place.names) - 1) // max(1, count - 1)))
        starts = list(range(len(place.names) - stride * (count - 1)))
    if not starts:
        return []
    start = int(make_generator(count, place.name, draw).choice(starts))
    return place.load_images([start + stride * index for index in range(count)])


def make_generator(count: int, text: str, draw: int) -> np.random.Generator:
    """Returns the source of random numbers for a number of images, a text and a draw."""
    return np.random.default_rng([count, zlib.crc32(text.encode()), *([draw] if draw else [])])


def run_trial(
    photos: Sequence[TrialImage],
    kind: AssumptionBreak,
    setting: str,
    known: dict[PieceKey, bytes],
    config: ReconstructionConfig,
) -> Trial:
    """`known` keeps features and matches of the photographs by their names, for the next trials of the scene."""
    generator = np.random.default_rng([len(photos), zlib.crc32(f"{photos[0].place} {kind.name}".encode())])
    changed = kind.change(set_intrinsics(photos, setting), generator)
    started = time.perf_counter()
    kept, _, rejected = screen_all(make_frames(changed), config.screening)
    prior = load_prior(config)
    pieces = {key: known[key] for key in select_keys(known.keys(), [photo.name for photo in changed])}
    keyframes = [prepare(frame, config, load_plain_features(pieces, frame.name)) for frame in kept]
    graph, found = match_keyframes(keyframes, pieces, config.matching, prior.matcher)
    known.update(found)
    graph = mask_moving_objects(graph, prior.matcher)
    estimate = run_fallbacks(estimate_cameras(graph, rejected, config), rejected, config)
    seconds = time.perf_counter() - started
    estimate, published = ensure_registration(estimate, config), estimate.verdict.publishable
    cameras = list_registered_cameras(estimate)
    score = score_cameras(cameras, (make_world(changed),), rough=estimate.verdict.code.value == ROUGH)
    ratios: dict[str, float] = {}
    bounds: dict[str, float] = {}
    worst = None
    if published and score.errors:
        for what in ("rotation", "centre", "focal"):
            each = {
                e.name: (e.pair_with_bounds()[what][0] / e.pair_with_bounds()[what][1])
                for e in score.errors
                if e.pair_with_bounds()
            }
            bounds[what] = float(
                np.median([e.pair_with_bounds()[what][1] for e in score.errors if e.pair_with_bounds()])
            )
            ratios[what] = max(each.values(), default=0.0)
        worst = max(
            score.errors,
            key=lambda e: max(x / b for x, b in e.pair_with_bounds().values()) if e.pair_with_bounds() else 0,
        ).name
    return Trial(
        photos[0].place, len(photos), kind.name, setting, estimate.verdict.code.value, published,
        published and not score.right, score.exact, len(cameras) if published else 0,
        ratios.get("rotation"), ratios.get("centre"), ratios.get("focal"),
        bounds.get("rotation"), bounds.get("centre"), bounds.get("focal"), worst, seconds, estimate.verdict.message,
        OURS, f"{photos[0].place}, {len(photos)} images: {kind.name}, {setting} told", score.errors,
        estimate.evidence_record,
    )  # fmt: skip


def run_scene(
    folder: Path,
    counts: Sequence[int],
    kinds: Sequence[str],
    settings: Sequence[str],
    journal: Path | None,
    sample: int | None = None,
    draw: int = 0,
) -> list[Trial]:
    """`sample`: at most so many kinds for each number of images and setting, drawn at random, besides the clean set.

    Windows and kinds of another `draw` are others.
    """
    scene = load_scene(folder)
    place = TrialScene(scene, tuple(name for name in scene.paths if name in scene.cameras))
    config, found = ReconstructionConfig(), []
    for count in counts:
        photos = window(place, count, draw)
        if not photos:
            continue
        caches: dict[str, dict[PieceKey, bytes]] = defaultdict(dict)
        for setting in settings:
            possible = [name for name in kinds if setting in _ALL_KINDS[name].settings and name != "clean"]
            drawn = make_generator(count, f"{place.name} {setting}", draw).permutation(possible)
            for name in [*(["clean"] if "clean" in kinds else []), *drawn[:sample].tolist()]:
                cache = caches["given" if setting == "given" else "centred"]
                trial = run_trial(photos, _ALL_KINDS[name], setting, cache, config)
                found.append(replace(trial, draw=draw))
                if journal is not None:
                    with journal.open("a") as lines:
                        lines.write(json.dumps(asdict(found[-1])) + "\n")
    return found


class Answer(Protocol):
    """Describes the outcome of a trial, of a scene, a number of images and a setting."""

    @property
    def scene(self) -> str: ...
    @property
    def count(self) -> int: ...
    @property
    def setting(self) -> str: ...
    @property
    def published(self) -> bool: ...
    @property
    def wrong(self) -> bool: ...


def find_answered(trials: Iterable[Answer]) -> set[tuple[str, int, str]]:
    """Returns scene, number of images and setting of the trials that are answered and not wrong."""
    return {(t.scene, t.count, t.setting) for t in trials if t.published and not t.wrong}


def format_answers(trials: Sequence[Answer], answerable: Collection[tuple[str, int, str]], reference: str) -> str:
    """Returns how many trials are answered and wrong, and the share of those that `reference` answers."""
    compared = [t for t in trials if (t.scene, t.count, t.setting) in answerable]
    good = sum(t.published and not t.wrong for t in compared)
    return (
        f"trials {len(trials):3d}, answered {sum(t.published for t in trials):3d}, wrong "
        f"{sum(t.wrong for t in trials):2d}; {reference} answered {len(compared):3d}, of these answered and not wrong "
        f"{good:3d} ({100 * good / max(1, len(compared)):.0f} %)"
    )


def table(trials: Sequence[Trial]) -> Iterator[str]:
    """Each kind and setting: trials, answered and right, wrong, refused, and the share of those whose clean set is."""
    clean = find_answered([t for t in trials if t.kind == "clean"])
    groups: dict[tuple[str, str], list[Trial]] = defaultdict(list)
    for trial in trials:
        groups[trial.kind, trial.setting].append(trial)
    damaged = [t for t in trials if t.kind != "clean"]
    for (kind, setting), rows in [*groups.items(), (("all damaged", "any"), damaged)]:
        yield f"{kind:24s} {setting:8s} {format_answers(rows, clean, 'clean')}"


def judge_without_scene(trials: Sequence[dict[str, Any]], samples: Sequence[Sample]) -> list[dict[str, object]]:
    """Judges each trial by numbers that were fitted without its scene; pairs have numbers of their own."""
    known: dict[tuple[str, bool], VerdictModel] = {}
    judged: list[dict[str, object]] = []
    for trial in trials:
        published = wrong = False
        for sample in make_trial_samples([dict(trial)]):
            key = sample.scene, sample.is_pair
            if key not in known:
                others = [each for each in samples if each.is_pair == sample.is_pair and each.scene != sample.scene]
                known[key] = fit_models(others)
            published = is_published(sample, known[key])
            wrong = published and exceeds_bounds(sample, known[key])
        names = {name: trial[name] for name in ("scene", "count", "kind", "setting", "draw") if name in trial}
        judged.append({**names, "published": published, "wrong": wrong})
    return judged


def write_judged(trials: Path, results: Sequence[Path], out: Path) -> None:
    """Writes the judged trials of a file."""
    judged = judge_without_scene(load_results(trials)["trials"], read_samples(list(results)))
    names = " ".join(path.name for path in results)
    command = f"python -m tests.bench lens_assumptions --judge {trials.name} --fitted-to {names} --out {out.name}"
    lines = ",\n".join(json.dumps(each) for each in judged)
    out.write_text(f'{{"command": {json.dumps(command)}, "trials": [\n{lines}\n]}}\n')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--out", type=Path, required=True, help="JSON file; FILE.jsonl beside it grows meanwhile")
    parser.add_argument("--judge", type=Path, help="a file of trials to be judged without their scenes; runs nothing")
    parser.add_argument(
        "--fitted-to", type=Path, nargs="+", default=(), help="the samples that --judge fits numbers to"
    )
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--kinds", nargs="+", choices=list(_ALL_KINDS), metavar="KIND")
    parser.add_argument("--later", action="store_true", help="kinds that were made after all numbers were fitted")
    parser.add_argument("--settings", nargs="+", default=SETTINGS)
    parser.add_argument("--sample", type=int, help="kinds for each scene, number of images and setting, at most")
    parser.add_argument(
        "--draw", type=int, default=0, help="of windows and kinds; 0 is that which numbers are fitted to"
    )
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    if arguments.judge:
        return write_judged(arguments.judge, arguments.fitted_to, arguments.out)
    journal = arguments.out.with_suffix(".jsonl")
    of_scene = partial(
        run_scene,
        counts=arguments.counts,
        kinds=arguments.kinds or list(LATER_KINDS if arguments.later else KINDS),
        settings=arguments.settings,
        journal=journal,
        sample=arguments.sample,
        draw=arguments.draw,
    )
    with ProcessPoolExecutor(arguments.processes) as pool:
        trials = [trial for found in pool.map(of_scene, arguments.scenes) for trial in found]
    lines = list(table(trials))
    arguments.out.write_text(json.dumps({"table": lines, "trials": [asdict(t) for t in trials]}, indent=1))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
