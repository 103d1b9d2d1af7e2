"""What `splatnode status` prints of a heartbeat, in plain words."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any


def _seconds(value: Any) -> str:
    return f"{value:.0f} s"


def _megabytes(value: Any) -> str:
    return f"{value:.1f} MB"


def _format_value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict) and {"name", "reason"} <= value.keys():  # a keyframe that was set aside
        return f"{value['name']}: {value['reason']}"
    if isinstance(value, dict) and {"scene_id", "keyframes"} <= value.keys():
        return _format_submap(value)
    return f"{value:.1f}" if isinstance(value, float) else str(value)


def _format_submap(value: Mapping[str, Any]) -> str:
    """`scene-0002: left, OK, 12 photographs, 1 left out, 43 s of work, 512 MB`."""
    kept, out = value["keyframes"], value.get("left_out")
    parts = [
        f"{value.get('state')}, {value.get('verdict')}",
        f"{kept} photograph{'' if kept == 1 else 's'}",
        f"{out} left out" if out else "",
        f"{value.get('seconds', 0):.0f} s of work",
        f"{value.get('rss_mb', 0):.0f} MB",
    ]
    return f"{value['scene_id']}: {', '.join(filter(None, parts))}"


# Field of a heartbeat -> what it is called, and how its value is written; other fields go by their names.
_WORDS: Mapping[str, tuple[str, Callable[[Any], str]]] = {
    "uptime_s": ("running for", _seconds),
    "rss_mb": ("memory", _megabytes),
    # capture's
    "pid": ("process", _format_value),
    "unusable": ("blurred, dark or copied", _format_value),
    "dropped": ("frames not readable", _format_value),
    "skipped": ("frames passed over", _format_value),
    "not_taken": ("keyframes without room", _format_value),
    "waiting": ("keyframes not at recon", _format_value),
    "waiting_mb": ("size of those", _megabytes),
    "acknowledged": ("keyframes at recon", _format_value),
    # recon's
    "scene_id": ("scene", _format_value),
    "keyframe": ("last keyframe", lambda number: f"number {number}"),
    "queue": ("keyframes waiting", _format_value),
    "num_gaussians": ("Gaussians", _format_value),
    "iterations": ("steps of refinement", _format_value),
    "bounds": ("cameras known", _format_value),
    "keyframe_s": ("last shown after", _seconds),
    "delay_s": ("delay", _seconds),
    "delay": ("because", _format_value),
    "unfinished": ("places to finish", _format_value),
    "newest_places": ("places", _format_value),
    "refused": ("refused messages", _format_value),
    "duplicates": ("keyframes come again", _format_value),
}
_NOT_PRINTED = {"session", "sequence", "mono_ns", "type", "state", "tracked"}  # they tell a user nothing
_NOTHING = ("", None, [])
_LOADING = "loading"  # recon's state in which it knows nothing yet: zeros would pass for what there is


def describe_heartbeat(room: str, fields: Mapping[str, Any]) -> list[str]:
    """Lines about the process of this room, by its heartbeat."""
    state = fields.get("state", "running")
    lines = [f"{room}: {state}"]
    for key, value in fields.items():
        if key in _NOT_PRINTED or value in _NOTHING or (key == "keyframe" and value == -1):
            continue
        if state == _LOADING and not value:
            continue
        name, written = _WORDS.get(key, (key.replace("_", " "), _format_value))
        shown = map(_format_value, value) if isinstance(value, list) else [written(value)]
        lines += [
            f"  {told:24}{each}"
            for told, each in zip(itertools.chain([name], itertools.repeat("")), shown, strict=False)
        ]
    return lines
