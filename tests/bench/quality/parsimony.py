"""What more and fewer Gaussians buy:
`python -m tests.bench parsimony [SCENE:VIEWS ...] --out parsimony.json [--chart parsimony.png]`.

Each set of photographs is registered once, and scenes are made from the same cameras and points: of the size that
splatnode chooses; of a quarter to four times of it; with a Gaussian a pixel; and, of the size that was chosen, by
Markov chain Monte Carlo from an even choice of the pixels. All are refined for as many iterations and scored alike.
Rows that the file holds already are not measured again, so it can be filled in parts: about 4 minutes of a core a case.
Of a set that is refused there is one row, without scores. With --race the sets are those of the race.
"""

from __future__ import annotations

import json
import pickle
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from msgspec.structs import replace

from splatnode.extras.evaluate.methods import Start, continue_reconstruction
from splatnode.extras.evaluate.protocol import Settings
from splatnode.recon.config import ReconstructionConfig, preset
from splatnode.recon.optimize.control import ControlChoice, prune, relocate
from splatnode.recon.result.export.formats.spz import encode_spz
from splatnode.recon.result.export.limits import sanitize_gaussians
from splatnode.recon.result.export.staged import json_bytes, write_file
from splatnode.recon.result.report import peak_rss_mb
from splatnode.recon.scene import initialization
from tests.bench.quality import race_cases
from tests.bench.quality.held_out import Case, Folders, Scoring, load_case, parsed, parser_of
from tests.bench.quality.parsimony_chart import PIXEL, RIVAL, SELF, draw, summary

CASES = (  # of which cameras are found
    *(f"{scene}:{views}" for scene in ("fountain_p11", "llff_flower", "sceaux") for views in (3, 6)),
    *(f"{scene}:6" for scene in ("llff_fern", "fox", "tum_fr3_office", "castle_p30")),
)
FACTORS = (1 / 4, 1 / 2, 2.0, 4.0)  # of the size that was chosen
ITERATIONS = 500


@dataclass(frozen=True)
class Row:
    scene: str
    views: int
    method: str  # SELF, PIXEL, RIVAL, or "x2" for twice the chosen size
    num_gaussians: int
    psnr: float | None
    ssim: float | None
    lpips: float | None
    ply_bytes: int | None
    spz_bytes: int
    seconds: float  # of the processor, from the points on
    peak_rss_mb: float | None  # of the process so far, cameras and points included where it found them itself


def configurations(chosen: int) -> dict[str, ReconstructionConfig]:
    """By method, with `chosen` the size that splatnode chose."""
    ours = preset("balanced")
    ours = replace(
        ours, optimize=replace(ours.optimize, iterations=ITERATIONS, doubtful_iterations=None, checkpoints=())
    )
    fine = replace(ours.initialization, max_error=1e-4, min_area_px=1.0)
    by_size = replace(ours.optimize, control=ControlChoice("prune", prune.Config(least_change=0.0)))
    by_pixel = replace(ours, pixelwise=initialization.PixelwiseConfig(), optimize=replace(ours.optimize, control=None))
    relocating = replace(ours.optimize, control=ControlChoice("relocate", relocate.Config()))
    forced = {
        f"x{factor:g}": replace(ours, initialization=fine, optimize=by_size, max_gaussians=round(factor * chosen))
        for factor in FACTORS
    }
    rival = replace(by_pixel, optimize=relocating, max_gaussians=chosen, surplus=1.0)
    return {SELF: ours, **forced, PIXEL: by_pixel, RIVAL: rival}


def measure(case: Case, start: Start, method: str, config: ReconstructionConfig, scoring: Scoring) -> Row:
    """One scene from the points to its scores. `start` is used up."""
    started = time.process_time()
    *_, snapshot = continue_reconstruction(start, config)
    seconds = time.process_time() - started
    peak = peak_rss_mb()
    scored = case.score(snapshot, method, scoring)
    return Row(
        scene=case.scene.name,
        views=len(case.split.train),
        method=method,
        num_gaussians=len(snapshot.gaussians),
        psnr=scored.psnr,
        ssim=scored.ssim,
        lpips=scored.lpips_alex,
        ply_bytes=scored.scene_bytes,
        spz_bytes=len(encode_spz(sanitize_gaussians(snapshot.gaussians))),
        seconds=seconds,
        peak_rss_mb=peak,
    )


def named(labels: Sequence[str], folders: Folders) -> Iterator[Case]:
    return (load_case(label, folders) for label in labels)


def sets(labels: Sequence[str], folders: Folders) -> Iterator[Case]:
    """Those of the race with these labels; all, if there are none."""
    for case in race_cases.cases():
        if not labels or case.label in labels:
            place = race_cases.linked(case, folders.scenes, folders.starts / "scenes")
            yield load_case(case.label, Folders(place.parent, folders.starts))


def fill(case: Case, rows: list[Row], folders: Folders, scoring: Scoring, out: Path, only: tuple[str, ...]) -> None:
    """Adds to `rows`, and to the file, what `case` lacks of the methods in `only`; of all, if that is empty."""
    mine = case.scene.name, len(case.split.train)
    known = {row.method: row for row in rows if (row.scene, row.views) == mine}
    for method in configurations(1):
        if method in known or (only and method not in only and method != SELF):
            continue
        if known and known[SELF].psnr is None:
            return
        config = configurations(known[SELF].num_gaussians if known else 1)[method]
        row = known[method] = measure(case, pickle.loads(case.start(folders)), method, config, scoring)
        rows.append(row)
        write(rows, scoring.settings, out)
        print(json.dumps(asdict(row)), flush=True)


def write(rows: list[Row], settings: Settings, out: Path) -> None:
    records = [asdict(row) for row in rows]
    content = {"summary": summary(records), "settings": asdict(settings), "iterations": ITERATIONS, "rows": records}
    write_file(out, json_bytes(content))


def main() -> None:
    parser = parser_of(__doc__, CASES)
    parser.add_argument("--methods", nargs="+", default=(), help="of these only, besides the chosen size")
    parser.add_argument("--race", action="store_true", help="the sets of the race, on which no size was chosen")
    parser.add_argument("--chart", type=Path, help="PNG file to draw from it")
    arguments, folders, scoring = parsed(parser)
    known = json.loads(arguments.out.read_text()) if arguments.out.exists() else {"rows": []}
    if known["rows"] and known["settings"] != asdict(scoring.settings):
        parser.error(f"{arguments.out} was scored with other settings: {known['settings']}. Name another file")
    rows = [Row(**row) for row in known["rows"]]
    for case in sets(arguments.cases, folders) if arguments.race else named(arguments.cases or CASES, folders):
        fill(case, rows, folders, scoring, arguments.out, tuple(arguments.methods))
    print(json.dumps(summary([asdict(row) for row in rows]), indent=1))
    if arguments.chart:
        arguments.chart.write_bytes(draw([asdict(row) for row in rows]))


if __name__ == "__main__":
    main()
