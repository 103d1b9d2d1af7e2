"""What it changes that no guessed surface lies on the path of the cameras:
`python -m tests.bench free_path [SCENE:VIEWS ...] --starts FOLDER --out free_path.json`.

Scenes of `balanced` from the same cameras and points, one seed, with the clearance of the defaults and with none. The
sets are those that presets were chosen on, and those of the race. A set that the file holds already is left as it is.
"""

from __future__ import annotations

import json
import pickle
from dataclasses import asdict, dataclass

from msgspec.structs import replace

from splatnode.extras.evaluate.methods import continue_reconstruction
from splatnode.recon.config import ReconstructionConfig, preset
from splatnode.recon.result.export.staged import json_bytes, write_file
from tests.bench.quality.held_out import Case, Folders, Scoring, load_case, parsed, parser_of
from tests.bench.quality.parsimony import sets

TUNED = (  # presets were chosen on these
    *(f"{scene}:6" for scene in ("fountain_p11", "llff_fern", "sceaux", "llff_flower", "tum_fr3_office")),
    *(f"{scene}:12" for scene in ("castle_p30", "fox")),
)
WITH, WITHOUT = "with", "without"


@dataclass(frozen=True)
class Row:
    set: str
    clearance: str  # WITH or WITHOUT
    num_gaussians: int
    psnr: float | None  # None: the set is refused
    ssim: float | None
    lpips: float | None


def configurations() -> dict[str, ReconstructionConfig]:
    ours = preset("balanced")
    without = replace(ours, completion=replace(ours.completion, clearance=0.0))
    return {WITH: ours, WITHOUT: without}


def measure(case: Case, label: str, folders: Folders, scoring: Scoring) -> list[Row]:
    rows = []
    for clearance, config in configurations().items():
        *_, snapshot = continue_reconstruction(pickle.loads(case.start(folders)), config)
        scored = case.score(snapshot, clearance, scoring)
        scores = scored.psnr, scored.ssim, scored.lpips_alex
        rows.append(Row(label, clearance, len(snapshot.gaussians), *scores))
        print(json.dumps(asdict(rows[-1])), flush=True)
        if scored.psnr is None:
            break
    return rows


def main() -> None:
    parser = parser_of(__doc__, TUNED)
    arguments, folders, scoring = parsed(parser)
    known = json.loads(arguments.out.read_text()) if arguments.out.exists() else {"rows": []}
    rows = [Row(**row) for row in known["rows"]]
    there = {row.set for row in rows}
    race = [label for label in arguments.cases if label not in TUNED]
    cases = [load_case(label, folders) for label in TUNED if label in (arguments.cases or TUNED)]
    if race or not arguments.cases:
        cases += sets(race, folders)
    for case in cases:
        label = f"{case.scene.name}:{len(case.split.train)}"
        if label in there:
            continue
        rows += measure(case, label, folders, scoring)
        content = {"settings": asdict(scoring.settings), "rows": [asdict(row) for row in rows]}
        write_file(arguments.out, json_bytes(content))


if __name__ == "__main__":
    main()
