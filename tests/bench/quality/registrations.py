"""What the numbers of the verdict are fitted to: `python -m tests.bench registrations SCENE ... --out DIR`.

Registrations of each scene's windows of 2, 3, 6 and 12 photographs: nothing told of the lens, EXIF's focal length
within 3 %, and the lens given (all windows of three, one of each stride of 6 and 12); and of the rows of the stability
matrix, cameras alone, four seeds each. They go into fit_windows.json.gz, fit_windows_exif.json.gz,
fit_windows_given.json.gz, fit_pairs.json.gz and fit_matrix.json.gz, which `python -m tests.bench fit` reads beside
lens_assumptions.json.gz, the trials of `python -m tests.bench lens_assumptions`.
"""

from __future__ import annotations

import argparse
import gzip
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from splatnode.extras.evaluate.stability import window_campaign
from splatnode.extras.evaluate.stability.campaign import ROWS
from splatnode.extras.evaluate.stability.perturbations import Sampler, load_scenes_by_motion, load_trial_scenes
from splatnode.extras.evaluate.stability.trial import (
    ROUGH,
    MatrixRow,
    classify_outcome,
    ensure_registration,
    list_registered_cameras,
    score_cameras,
)
from splatnode.extras.evaluate.stability.windows import (
    OURS,
    PieceKey,
    Window,
    draw_windows,
    judge_window,
    select_keys,
    select_moving_scenes,
)
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import load_prior
from splatnode.recon.pipeline import estimate_frame_cameras
from splatnode.recon.threads import Clock

SEEDS = 4
LENS_ROWS = 31  # of the matrix from this number on: `degradations` has them on more scenes
# Rows that ask something else than whether cameras are right
OTHERS = (
    "soak", "determinism", "overfit", "gross model", "a huge file", "damaged files", "nothing but damaged files",
    "one by one", "single view", "pure noise", "numbers out of order", "epsilon noise", "shuffled",
    "every frame twice", "one frame many times",
)  # fmt: skip


def plan(place_windows: partial[list[Window]]) -> Iterator[tuple[Window, window_campaign.LensSetting]]:
    """The windows of a place and what is told, in an order in which they share most of what was found."""
    something: tuple[window_campaign.LensSetting, ...] = ("exif", "given")
    asked: list[tuple[Window, window_campaign.LensSetting]] = [
        (window, "nothing") for window in place_windows(2, counts=(2, 3, 6, 12))
    ]
    for window in [*place_windows(2, counts=(3,)), *place_windows(1, counts=(6, 12))]:
        asked.extend((window, told) for told in something)
    asked.sort(key=lambda each: (each[0].count, each[0].stride, each[0].start, each[1]))
    yield from asked


def of_scene(scene: Path, out: Path) -> list[dict[str, Any]]:
    """The rows of the scene's windows, each with what was told."""
    rows, caches = [], defaultdict[str, dict[PieceKey, bytes]](dict)
    for place in select_moving_scenes(load_trial_scenes([scene], out)):
        for window, told in plan(partial(draw_windows, place, seed=0)):
            cache = caches["given" if told == "given" else "centred"]
            known = {key: cache[key] for key in select_keys(cache.keys(), window.names)}
            answer, found = window_campaign.reconstruct_window(
                place, window, ReconstructionConfig(), False, told, known
            )
            cache.update(found)
            rows.append({"told": told, "row": asdict(judge_window(window, OURS, answer, place.scene.cameras))})
    (out / f"{scene.name}.json").write_text(json.dumps(rows))  # should a later scene fail
    return rows


def of_row(job: tuple[int, int], scenes: Sequence[Path], out: Path) -> dict[str, object] | None:
    """A trial of a row of the matrix by its position, and its seed; None where the scenes do not do for it."""
    row, seed = ROWS[job[0]], job[1]
    try:
        case = row.make(Sampler(load_scenes_by_motion(scenes, out), row.name, seed))
    except ValueError:
        return None
    found, _ = estimate_frame_cameras(case.source(), load_prior(case.config), case.config, Clock())
    estimate = ensure_registration(found, case.config)
    cameras, verdict = list_registered_cameras(estimate), estimate.verdict
    score = score_cameras(cameras, case.worlds, rough=verdict.code.value == ROUGH)
    ended = classify_outcome(case.demand, verdict.publishable, score.right, verdict.code in case.codes)
    return {
        "row": row.number, "name": row.name, "seed": seed, "method": OURS, "note": case.note,
        "verdict": verdict.code.value, "published": verdict.publishable, "outcome": ended.value,
        "errors": [asdict(error) for error in score.errors], "evidence": estimate.evidence_record,
        "registered_right": score.exact, "message": verdict.message,
    }  # fmt: skip


def asks_for_cameras(row: MatrixRow) -> bool:
    return row.name not in OTHERS and row.number < LENS_ROWS


def write(file: Path, content: dict[str, object]) -> None:
    with gzip.GzipFile(file, "wb", mtime=0) as target:
        target.write(json.dumps(content).encode())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    out, command = arguments.out, "python -m tests.bench registrations SCENE ... --out DIR"
    out.mkdir(parents=True, exist_ok=True)
    jobs = [(index, seed) for index, row in enumerate(ROWS) if asks_for_cameras(row) for seed in range(SEEDS)]
    with ProcessPoolExecutor(arguments.processes) as pool:
        load_trial_scenes(arguments.scenes, out)  # a folder that is no scene ends the run now, not after an hour
        rows = [row for found in pool.map(partial(of_scene, out=out), arguments.scenes) for row in found]
        trials = list(pool.map(partial(of_row, scenes=arguments.scenes, out=out), jobs))
    for told, name in (("nothing", "fit_windows"), ("exif", "fit_windows_exif"), ("given", "fit_windows_given")):
        chosen = [row["row"] for row in rows if row["told"] == told and row["row"]["count"] > 2]
        write(out / f"{name}.json.gz", {"commands": [command], "told": told, "rows": chosen})
    pairs = [row["row"] for row in rows if row["row"]["count"] == 2]
    write(out / "fit_pairs.json.gz", {"commands": [command], "told": "nothing", "rows": pairs})
    write(out / "fit_matrix.json.gz", {"command": command, "trials": [trial for trial in trials if trial is not None]})


if __name__ == "__main__":
    main()
