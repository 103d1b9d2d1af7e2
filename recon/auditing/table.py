"""An audit in words, and as values for JSON."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence

from splatnode.recon.auditing.audit import Audit
from splatnode.recon.auditing.history import Period
from splatnode.recon.auditing.motion import MeasuredMotion
from splatnode.recon.auditing.sighting import SightingFailure
from splatnode.recon.auditing.stations import StationRecording

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
