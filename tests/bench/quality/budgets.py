"""What limits on iterations, Gaussians, size and time cost:
`python -m tests.bench budgets [SCENE:VIEWS ...] --starts FOLDER --out budgets.json`.

From the same cameras and points, scenes within rising limits of each kind, and the one without limits at each of its
checkpoints. Told: whether quality ever falls when a limit rises, and what the scene was worth at every moment. Limits
that the file holds already are not measured again, so it can be filled in parts: about 6 minutes of a core a case.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise

from msgspec.structs import replace

from splatnode.extras.evaluate.methods import continue_reconstruction
from splatnode.recon.config import ReconstructionConfig, preset
from splatnode.recon.result.snapshot import Snapshot
from tests.bench.quality.held_out import Case, Scoring, load_case, parsed, parser_of

CASES = ("fountain_p11:6", "llff_fern:6")
LIMITS: dict[str, tuple[float, ...]] = {
    "max_gaussians": (2_000, 6_000, 18_000, 54_000),
    "max_mb": (0.125, 0.4, 1.2, 3.6),
    "budget_s": (1.0, 3.0, 9.0, 27.0),  # after the points
}
CHECKPOINTS = (25, 50, 100, 200)  # iterations
ANYTIME = "iterations"
WORSE = {"psnr": 0.05, "ssim": 0.005, "lpips": 0.002}  # a fall within which quality counts as equal


@dataclass(frozen=True)
class Row:
    scene: str
    views: int
    limit: str  # one of LIMITS, or ANYTIME: a moment of the scene without limits
    value: float
    num_gaussians: int
    seconds: float  # after the points
    hit: bool  # the report says that the limit bound the scene
    psnr: float | None
    ssim: float | None
    lpips: float | None


def snapshots(start: bytes, limit: str, value: float) -> Iterator[Snapshot]:
    """A reconstruction from the points on, within one limit; for ANYTIME without any."""
    begun = pickle.loads(start)
    config = preset("balanced")
    if limit == ANYTIME:
        config = replace(config, optimize=replace(config.optimize, checkpoints=CHECKPOINTS))
    else:
        config = within(config, limit, value, begun.seconds)
    return continue_reconstruction(begun, config)


def within(config: ReconstructionConfig, limit: str, value: float, spent: float) -> ReconstructionConfig:
    """`config` with a limit; one of time is counted from the points on, which took `spent` seconds."""
    if limit == "budget_s":
        return replace(config, budget_s=spent + value)
    return replace(config, **{limit: round(value) if limit == "max_gaussians" else value})


def measured(case: Case, start: bytes, scoring: Scoring, known: Collection[tuple[str, float]]) -> Iterator[Row]:
    """All rows of a set of photographs but those whose limit and value are `known`."""
    spent = pickle.loads(start).seconds
    moments = *CHECKPOINTS, preset("balanced").optimize.iterations
    if any((ANYTIME, moment) not in known for moment in moments):
        *shown, _ = snapshots(start, ANYTIME, 0)  # the last is the one before, declared final
        for snapshot in shown:
            if (ANYTIME, snapshot.iterations) not in known:
                yield scored(snapshot, ANYTIME, snapshot.iterations, spent, case, scoring)
    for limit, values in LIMITS.items():
        for value in values:
            if (limit, value) not in known:
                *_, snapshot = snapshots(start, limit, value)
                yield scored(snapshot, limit, value, spent, case, scoring)


def scored(snapshot: Snapshot, limit: str, value: float, spent: float, case: Case, scoring: Scoring) -> Row:
    row = case.score(snapshot, limit, scoring)
    return Row(
        scene=case.scene.name,
        views=len(case.split.train),
        limit=limit,
        value=value,
        num_gaussians=len(snapshot.gaussians),
        seconds=snapshot.seconds["total"] - spent,
        hit=any(hit["limit"] == limit for hit in snapshot.budget),
        psnr=row.psnr,
        ssim=row.ssim,
        lpips=row.lpips_alex,
    )


def falls(rows: Sequence[Row]) -> list[str]:
    """Where more bought less: each step to the next higher limit of a kind after which a measure is clearly worse."""
    found = []
    for earlier, later in pairwise(rows):
        if (earlier.scene, earlier.views, earlier.limit) != (later.scene, later.views, later.limit):
            continue
        for measure, tolerance in WORSE.items():
            before, after = getattr(earlier, measure), getattr(later, measure)
            loss = after - before if measure == "lpips" else before - after
            if loss > tolerance:
                step = f"{earlier.limit} {earlier.value:g} to {later.value:g}"
                found.append(f"{later.scene} {later.views}, {step}: {measure} {before:.3f} to {after:.3f}")
    return found


def main() -> None:
    arguments, folders, scoring = parsed(parser_of(__doc__, CASES))
    before = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    rows = [Row(**row) for row in before]
    for name in arguments.cases or CASES:
        case = load_case(name, folders)
        mine = case.scene.name, len(case.split.train)
        known = {(row.limit, row.value) for row in rows if (row.scene, row.views) == mine}
        for row in measured(case, case.start(folders), scoring, known):
            rows.append(row)
            print(json.dumps(asdict(row)), flush=True)
            content = {"falls": falls(rows), "rows": [asdict(each) for each in rows]}
            arguments.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
