"""The sets of the race: race_cases.json has scenes and photographs that no default or preset was chosen on."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec

CASES = Path(__file__).with_suffix(".json")


class Case(msgspec.Struct, frozen=True):
    name: str
    scene: str
    train: tuple[str, ...]
    test: tuple[str, ...]

    @property
    def label(self) -> str:
        return f"{self.name}:{len(self.train)}"


def cases() -> list[Case]:
    return msgspec.json.decode(CASES.read_bytes(), type=list[Case])


def linked(case: Case, scenes: Path, folder: Path) -> Path:
    """A folder of the case's own name that shows the scene, beside the splits.json that lists its photographs."""
    place = folder / f"{case.name}_{len(case.train)}"
    place.mkdir(parents=True, exist_ok=True)
    link = place / case.name
    if not link.is_symlink():
        link.symlink_to((scenes / case.scene).resolve())
    split = {case.name: {f"train{len(case.train)}": case.train, "test": case.test}}
    (place / "splits.json").write_text(json.dumps(split))
    return link
