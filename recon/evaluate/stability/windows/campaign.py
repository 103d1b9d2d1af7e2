"""All windows of a plan, scene after scene; what is on the disk already is not run again."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import msgspec

from splatnode.recon.config import Config
from splatnode.recon.evaluate.json_file import read_json
from splatnode.recon.evaluate.records import this_machine
from splatnode.recon.evaluate.stability.places import Place
from splatnode.recon.evaluate.stability.windows import ours
from splatnode.recon.evaluate.stability.windows.row import OURS, Answer, Found, Row, judged, key_of
from splatnode.recon.evaluate.stability.windows.summary import summarise
from splatnode.recon.evaluate.stability.windows.window import COUNTS, Window, moving, windows_of
from splatnode.recon.result.export.staged import json_bytes, write_file

logger = logging.getLogger(__name__)

FILE = "windows.json"
WRITE_EVERY_S = 5.0


@dataclass(frozen=True)
class Plan:
    methods: tuple[str, ...]
    per_kind: int = 2  # windows of each scene, count and stride, at most
    counts: tuple[int, ...] = COUNTS
    seed: int = 0  # of the draw of the windows
    given_lens: bool = False  # splatnode is told the true intrinsics, as of a calibrated camera
    fresh: bool = False  # measures each window's seconds from photographs on, too
    timeout_s: float = 120.0  # of a rival on one window
    config: Config = field(default_factory=Config)


def run_windows(plan: Plan, places: Sequence[Place], out: Path, command: str) -> list[Row]:
    """Runs what is missing in `out`/windows.json and returns all its rows. Rows without an answer are run again.

    The file is rewritten every few seconds and at the end, also where that is an exception or an interruption.
    """
    rows = {row.key: row for row in read_rows(out / FILE)}
    done = {key for key, row in rows.items() if _is_done(row, plan)}
    chosen = [(place, windows_of(place, plan.per_kind, plan.seed, plan.counts)) for place in moving(places)]
    asked = [key_of(window, method) for _, windows in chosen for window in windows for method in plan.methods]
    number, written = sum(key in done for key in asked), time.monotonic()
    try:
        for place, windows in chosen:
            jobs = [(method, window) for window in windows for method in plan.methods]
            for method, window, answer in _answers(place, [j for j in jobs if key_of(j[1], j[0]) not in done], plan):
                row = judged(window, method, answer, place.scene.cameras)
                rows[row.key] = row
                number += 1
                logger.info(
                    f"windows {number}/{len(asked)}: {row.scene}, {row.count} at stride {row.stride} from {row.start}, "
                    f"{row.method}: {row.verdict}, {row.found.value}"
                )
                if time.monotonic() - written > WRITE_EVERY_S:
                    write_file(out / FILE, _content(list(rows.values()), plan, command))
                    written = time.monotonic()
    finally:
        write_file(out / FILE, _content(list(rows.values()), plan, command))
    return list(rows.values())


def _is_done(row: Row, plan: Plan) -> bool:
    return row.found is not Found.FAILED and (row.fresh_seconds is not None or not plan.fresh)


class _Rows(msgspec.Struct, frozen=True):
    rows: list[Row]


def read_rows(path: Path) -> list[Row]:
    """The rows of a windows.json; none where there is no such file. Raises EvaluationFileError for another file."""
    if not path.exists():
        return []
    return read_json(path, _Rows, "the windows.json of this version").rows


def _answers(place: Place, todo: Sequence[tuple[str, Window]], plan: Plan) -> Iterator[tuple[str, Window, Answer]]:
    mine = [window for method, window in todo if method == OURS]
    for window, answer in ours.answers(place, mine, plan.config, plan.fresh, plan.given_lens):
        yield OURS, window, answer
    others = [(method, window) for method, window in todo if method != OURS]
    if others:
        from splatnode.recon.evaluate.stability.windows import rivals  # needs pycolmap

        for (method, window), answer in rivals.answers(place, others, plan.config, plan.fresh, plan.timeout_s):
            yield method, window, answer


def _content(rows: Sequence[Row], plan: Plan, command: str) -> bytes:
    content = {
        "command": command,
        "machine": this_machine(),
        "seed": plan.seed,
        "given_lens": plan.given_lens,
        "summary": summarise(rows),
        "rows": [{**asdict(row), "right": row.right, "found": row.found.value} for row in rows],
    }
    return json_bytes(content)
