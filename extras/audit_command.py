"""The verb audit: which camera of a station moved, when and by how much, in words and as values for JSON."""

from __future__ import annotations

import argparse
import html
from collections import defaultdict
from collections.abc import Iterator, Sequence

from splatnode.capture.lenses import read_lens
from splatnode.capture.process.terminal import say, show_progress
from splatnode.extras.audit import (
    Audit,
    MeasuredMotion,
    Period,
    SightingFailure,
    StationRecording,
    find_recordings,
    load_first_frames,
)
from splatnode.extras.audit import audit as audited
from splatnode.recon.locating.localize import check_lens
from splatnode.recon.result.export.staged import json_bytes, write_file
from splatnode.recon.result.stored_snapshot import read_landmarks

_MOST_LINES = 3  # of one camera for one reason; of more recordings the first is told, and how many there are
_MOST_NAMES = 8  # of cameras, in one line


def format_heading(recordings: Sequence[StationRecording]) -> str:
    """How what was named is read: which recordings, and which cameras."""
    cameras = sorted({camera for recording in recordings for camera in recording.cameras})
    first, last, count = recordings[0].name, recordings[-1].name, len(recordings)
    visits = f"{count} recordings, {first} to {last}" if count > 1 else f"1 recording, {first}"
    named = ", ".join(cameras[:_MOST_NAMES]) + (", ..." if len(cameras) > _MOST_NAMES else "")
    return f"{visits}, of {len(cameras)} camera{'s' if len(cameras) != 1 else ''}{named and ': '}{named}"


def format_lines(audit: Audit) -> Iterator[str]:
    """Formats lines: first what moved, then what stood still, then what is not known."""
    for move in audit.moves:
        when = f"moved between {audit.recordings[move.after]} and {audit.recordings[move.before]}"
        if len(move.cameras) > 1:
            together = f"{', '.join(move.cameras[:-1])} and {move.cameras[-1]}"
            all_of_them = set(move.cameras) == set(audit.periods)
            what = ": all cameras, or the scene before them" if all_of_them else ""
            yield f"{together} {when} as one body{what}"
        for camera in move.cameras:
            later = next(each for each in audit.periods[camera][1:] if each.recordings[0] >= move.before)
            assert later.came_by is not None  # it is not the first period
            yield f"{camera} {when} by {format_amount(audit, later.came_by)}"
    for camera, history in audit.periods.items():
        if len(history) == 1:
            yield f"{camera} {_format_still_period(audit, history[0])}"
    for camera in sorted(audit.not_seen):
        yield from _format_not_compared(audit, camera)
    for number, reason in audit.unreadable.items():
        yield f"{audit.recordings[number]} was not compared: {reason}"


def _format_not_compared(audit: Audit, camera: str) -> Iterator[str]:
    by_code: defaultdict[str, list[tuple[int, SightingFailure]]] = defaultdict(list)
    for number, problem in sorted(audit.not_seen[camera].items()):
        by_code[problem.code].append((number, problem))
    for code, problems in by_code.items():
        names = [audit.recordings[number] for number, _ in problems]
        if len(problems) > _MOST_LINES:
            names = [f"{len(names)} recordings, the first {names[0]}"]
        for name, (_, problem) in zip(names, problems, strict=False):
            yield f"{camera} was not compared in {name}: {code}: {problem.message}"


def format_amount(audit: Audit, motion: MeasuredMotion) -> str:
    """How far, with two standard deviations."""
    return motion.format_motion(audit.unit, audit.metric)


def _format_still_period(audit: Audit, period: Period) -> str:
    if period.last_motion is None:
        return f"was placed in {audit.recordings[period.recordings[0]]} alone: there is nothing to compare it with"
    noticed = period.last_motion
    shift = noticed.least_shift
    length = f"{100 * shift:.2g} cm" if audit.metric else f"{100 * shift / audit.unit:.2g} % of the distance"
    return (
        f"stood still in {len(period.recordings)} recordings: "
        f"a turn of {noticed.least_turn_deg:.2g} degrees or a shift of {length} would have been noticed"
    )


def make_values(audit: Audit) -> dict[str, object]:
    """For a file: poses are T_world_camera (4, 4) in the world of the result, turns in degrees, lengths in its unit."""
    return {
        "scale": "metric" if audit.metric else "relative",
        "distance": audit.unit,
        "recordings": list(audit.recordings),
        "not_read": [
            {"recording": audit.recordings[number], "message": reason} for number, reason in audit.unreadable.items()
        ],
        "moves": [
            {
                "after": audit.recordings[move.after],
                "before": audit.recordings[move.before],
                "cameras": list(move.cameras),
            }
            for move in audit.moves
        ],
        "cameras": {
            camera: {
                "periods": [_period(audit, each) for each in audit.periods.get(camera, ())],
                "not_compared": [
                    {
                        "recording": audit.recordings[number],
                        "photograph": problem.photograph,
                        "code": problem.code,
                        "message": problem.message,
                    }
                    for number, problem in sorted(audit.not_seen.get(camera, {}).items())
                ],
            }
            for camera in sorted({*audit.periods, *audit.not_seen})
        },
    }


def _period(audit: Audit, period: Period) -> dict[str, object]:
    located, noticed = period.sighting.placed.located, period.last_motion
    return {
        "recordings": [audit.recordings[number] for number in period.recordings],
        "T_world_camera": located.T_world_camera.tolist(),
        "K": located.K.tolist(),
        "claim": {"rotation_deg": located.claim.rotation_deg, "centre": located.claim.centre},
        "came_by": None if period.came_by is None else _motion(period.came_by),
        "noticed_from": None if noticed is None else {"turn_deg": noticed.least_turn_deg, "shift": noticed.least_shift},
    }


def _motion(motion: MeasuredMotion) -> dict[str, object]:
    return {
        "T_before_after": motion.T_before_after.tolist(),
        "covariance": motion.covariance.tolist(),
        "turn_deg": motion.degrees,
        "shift": motion.distance,
        "common_points": motion.common,
    }


def format_summary(audit: Audit) -> str:
    """How many moved, in one line."""
    cameras, moved = {*audit.periods, *audit.not_seen}, {name for move in audit.moves for name in move.cameras}
    return (
        f"{len(moved)} of {len(cameras)} cameras moved in {len(audit.recordings)} recordings; "
        f"{len(audit.comparable_cameras)} could be compared"
    )


# An audit as a picture (SVG): a row a camera, a column a recording, another colour after each move.

_CELL, _GAP, _LEFT, _TOP, _LINE = 26, 2, 170, 120, 30  # pixels
_WORDS = 400  # pixels beside the cells, for what a camera did
_MAX_LABELS = 40  # recordings whose names are written; of more, some
_COLOURS = ("#4c78a8", "#f58518", "#54a24b", "#b279a2", "#e45756", "#72b7b2", "#9d755d", "#eeca3b")
_NOT_SEEN = "#dddddd"
_LONGEST = 22  # characters of a name that are written


def draw_audit(audit: Audit) -> bytes:
    """The picture; what a cell stands for is told where the mouse rests on it."""
    cameras = sorted({*audit.periods, *audit.not_seen})
    right = _LEFT + len(audit.recordings) * _CELL + 10
    width = right + _WORDS
    height = _TOP + len(cameras) * _LINE + 60
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="sans-serif" font-size="12">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    every = max(1, -(-len(audit.recordings) // _MAX_LABELS))
    for number in range(0, len(audit.recordings), every):
        x = _LEFT + number * _CELL + _CELL / 2
        name = _escape_name(audit.recordings[number])
        parts.append(f'<text transform="translate({x + 4},{_TOP - 8}) rotate(-60)">{name}</text>')
    for row, camera in enumerate(cameras):
        y = _TOP + row * _LINE
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 18}" text-anchor="end">{_escape_name(camera)}</text>')
        not_seen = {number: f"{each.code}: {each.message}" for number, each in audit.not_seen.get(camera, {}).items()}
        for number, title in {**audit.unreadable, **not_seen}.items():
            parts.append(_draw_cell(number, y, _NOT_SEEN, title))
        for index, period in enumerate(audit.periods.get(camera, ())):
            title = (
                "where it stood first" if period.came_by is None else f"moved by {format_amount(audit, period.came_by)}"
            )
            for number in period.recordings:
                parts.append(_draw_cell(number, y, _COLOURS[index % len(_COLOURS)], title))
            if period.came_by is not None:
                x = _LEFT + period.recordings[0] * _CELL - _GAP / 2
                parts.append(
                    f'<line x1="{x}" x2="{x}" y1="{y - 2}" y2="{y + _CELL + 2}" stroke="black" stroke-width="3"/>'
                )
        did = [format_amount(audit, each.came_by) for each in audit.periods.get(camera, ()) if each.came_by is not None]
        words = did[0] if len(did) == 1 else f"{len(did)} moves" if did else ""
        parts.append(f'<text x="{right}" y="{y + 18}">{html.escape(words)}</text>')
    y = _TOP + len(cameras) * _LINE + 28
    parts.append(f'<rect x="{_LEFT}" y="{y - 11}" width="12" height="12" fill="{_NOT_SEEN}"/>')
    parts.append(f'<text x="{_LEFT + 18}" y="{y}">not compared; a bar: the camera moved</text>')
    return "\n".join([*parts, "</svg>\n"]).encode()


def _draw_cell(number: int, y: float, colour: str, title: str) -> str:
    x = _LEFT + number * _CELL
    rectangle = f'<rect x="{x}" y="{y}" width="{_CELL - _GAP}" height="{_CELL}" fill="{colour}">'
    return f"{rectangle}<title>{html.escape(title)}</title></rect>"


def _escape_name(name: str) -> str:
    return html.escape(name if len(name) <= _LONGEST else f"...{name[3 - _LONGEST :]}")


EXIT_GOOD, EXIT_NOTHING = 0, 65


def audit(args: argparse.Namespace) -> int:
    """Prints what moved, then what stood still; EXIT_NOTHING where no camera could be compared."""
    landmarks = read_landmarks(args.result)
    given = None if args.intrinsics is None else read_lens(args.intrinsics)
    visits = find_recordings(args.recordings)
    if given is not None:
        check_lens(given, load_first_frames(visits))
    say(format_heading(visits))
    with show_progress() as tell:
        found = audited(landmarks, visits, given, args.fov, tell)
    for line in format_lines(found):
        say(line)
    say(format_summary(found))
    for path, content in ((args.json, json_bytes(make_values(found))), (args.picture, draw_audit(found))):
        if path is not None:
            write_file(path, content)
            say(f"results: {path}")
    return EXIT_GOOD if found.comparable_cameras else EXIT_NOTHING
