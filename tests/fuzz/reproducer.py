"""A defect as a file that shows it again: the boundary, the seed, the number of the case, and the bytes themselves."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

REPLAY = "./run fuzz --replay"


@dataclass(frozen=True)
class Defect:
    """What went wrong with a case."""

    boundary: str
    seed: int
    number: int  # of the case
    problem: str
    case: Any = None  # None: its process ended, so that only seed and number tell it

    @property
    def kind(self) -> str:
        """Defects of one boundary and kind most likely have one cause."""
        what, _, rest = self.problem.partition(": ")
        place = rest.rpartition(" at ")[2] if " at " in rest else ""
        return re.sub(r"[0-9]+", "0", what) + place


def save(defect: Defect, folder: Path, commit: str) -> Path:
    """Writes the file of a defect; its name tells boundary, seed and number."""
    folder.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"[^a-z0-9]+", "_", defect.boundary.lower()).strip("_")
    path = folder / f"{name}-{defect.seed}-{defect.number}.json"
    told = {
        "boundary": defect.boundary,
        "seed": defect.seed,
        "number": defect.number,
        "problem": defect.problem,
        "commit": commit,
        "command": f"{REPLAY} {path}",
        "case": None if defect.case is None else base64.b64encode(msgspec.msgpack.encode(defect.case)).decode(),
    }
    path.write_text(json.dumps(told, indent=1) + "\n")
    return path


def load(path: Path) -> Defect:
    """What `save` wrote; a case that it does not hold is None. Raises ValueError, OSError."""
    told = json.loads(path.read_text())
    try:
        case = None if told["case"] is None else msgspec.msgpack.decode(base64.b64decode(told["case"]))
        return Defect(told["boundary"], told["seed"], told["number"], told["problem"], case)
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} must be a reproducer that fuzzing wrote, it lacks {error}; give one") from error
