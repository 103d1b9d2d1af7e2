"""What the panel says, in plain words."""

from __future__ import annotations

from splatnode.recon.result.snapshot import CameraEstimate, format_camera_bounds, format_widest_bounds
from splatnode.recon.result.stored_snapshot import format_percent
from splatnode.viewer.analysis import Advice
from splatnode.viewer.shapes import Ground, format_length
from splatnode.viewer.state import History, Moment, ViewerState, moment_index
from splatnode.viewer.state import place_lines as graph_lines

_STALE_S = 5.0  # a node that is at work is heard from more often
_MOST_DROPPED = 6
NO_SPLATS = (
    "Open3D's splat shader leaves parts of the picture black on software Vulkan: here Open3D draws points (g), "
    "and Gaussians stay with splatnode's own rasteriser"
)


def verdict_lines(moment: Moment) -> list[str]:
    """The verdict, what to do about it, and which frames it is about."""
    verdict = moment.snapshot.verdict
    lines = [f"{verdict.code.value}: {verdict.message}"]
    if verdict.advice:
        lines.append(f"What to do: {verdict.advice}")
    if verdict.frames:
        lines.append(f"About: {', '.join(verdict.frames)}")
    return lines


def count_lines(moment: Moment) -> list[str]:
    """How much there is and how long it took."""
    snapshot = moment.snapshot
    cameras = len(snapshot.cameras)
    lines = [f"{thousands(len(snapshot.gaussians))} Gaussians, {cameras} camera{'s' * (cameras != 1)}"]
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in snapshot.seconds.items() if name != "total")
    total = snapshot.seconds.get("total", sum(snapshot.seconds.values()))
    if snapshot.seconds:
        lines.append(f"{total:.1f} s" + (f" ({stages})" if stages else ""))
    if snapshot.iterations:
        lines.append(f"{thousands(snapshot.iterations)} iterations{', finished' if snapshot.final else ''}")
    return lines


def place_lines(moment: Moment) -> list[str]:
    """The places of a map, the nearest first; none for a single scene."""
    return [] if moment.graph is None else graph_lines(moment.graph)


def scale_lines(moment: Moment, ground: Ground | None) -> list[str]:
    """The unit of all lengths, and how wide the cells of the ground's grid are."""
    scale = moment.snapshot.scale
    lines = [f"Scale: {scale.sentence}"]
    return lines if ground is None else [*lines, f"Ground: cells of {format_length(ground.cell, scale)}"]


def bounds_lines(moment: Moment, camera: CameraEstimate | None = None) -> list[str]:
    """How well `camera` is known, or where there is none, or one without bounds: how well all are at least.

    With how far the poses that were given are from the estimated ones.
    """
    snapshot = moment.snapshot
    if camera is not None and camera.bounds is not None:
        bounds = format_camera_bounds(camera.bounds, snapshot.scale)
        return [f"{camera.name}: {bounds}", *describe_given_poses(moment, camera)]
    known = format_widest_bounds(snapshot.cameras, snapshot.scale)
    return [*([f"Cameras: {known}"] if known else []), *describe_given_poses(moment)]


def describe_given_poses(moment: Moment, camera: CameraEstimate | None = None) -> list[str]:
    """How far the pose that was given for `camera`, or where there is none, the worst of all, is from its estimate."""
    of = moment.snapshot.cameras if camera is None else (camera,)
    known = [(each, residual) for each in of if (residual := each.pose_residual) is not None]
    if not known:
        return []
    worst, (length, degrees) = max(known, key=lambda pair: pair[1][0])
    off = f"{format_length(length, moment.snapshot.scale)} and {degrees:.2g} degrees"
    if camera is not None:
        return [f"{worst.name}: its given pose is off by {off}"]
    return [f"Given poses: {len(known)}, at most {off} off ({worst.name})"]


def depth_lines(moment: Moment, camera: CameraEstimate | None = None) -> list[str]:
    """How many pixels of `camera`, or where there is none, of all, have multi-view consistent depth, if it is known."""
    if camera is not None:
        known = camera.consistent_depth
        return [] if known is None else [f"{camera.name}: other views confirm {format_percent(known)} of its depth"]
    total = moment.snapshot.consistent_depth
    if total is None:
        return []
    least = min(view_shares(moment), key=lambda share: share[1])
    of_all = f"Depth: other views confirm it in {format_percent(total)} of the pixels"
    return [f"{of_all}, least in {least[0]}: {format_percent(least[1])}"]


def view_shares(moment: Moment) -> list[tuple[str, float]]:
    """Each view's name and its share of pixels with multi-view consistent depth, where that is known."""
    known = ((camera.name, camera.consistent_depth) for camera in moment.snapshot.cameras)
    return [(name, share) for name, share in known if share is not None]


def view_depth_lines(moment: Moment, most: int) -> list[str]:
    """The share of each view, the smallest first; of more than `most` views the number of the others."""
    shares = sorted(view_shares(moment), key=lambda share: share[1])
    lines = [f"{name}: {format_percent(share)}" for name, share in shares[:most]]
    return lines + [f"{len(shares) - most} more, with larger shares"] * (len(shares) > most)


def rejection_lines(moment: Moment, most: int = _MOST_DROPPED) -> list[str]:
    """The frames that were left out, the latest last, each with its reason; of more than `most` only their number."""
    dropped = moment.snapshot.dropped
    lines = [f"left out {frame.name}: {frame.reason}" for frame in dropped[-most:]]
    earlier = len(dropped) - len(lines)
    return [f"{earlier} photographs were left out before:"] * (earlier > 0) + lines


def advice_line(advice: Advice | None, moment: Moment) -> str:
    """The next view; where the verdict says what to do, that comes first."""
    if moment.snapshot.final and moment.snapshot.verdict.publishable and not moment.snapshot.cameras:
        return "not known, because the file tells of no cameras."
    if not moment.snapshot.cameras or not moment.snapshot.verdict.publishable:
        return moment.snapshot.verdict.advice or "Take photographs that overlap, with a step to the side."
    if moment.graph is not None:
        return "not worked out for a map of several scenes."
    return "looking for the best next view" if advice is None else advice.sentence


def time_line(state: ViewerState, history: History) -> str:
    """Describes the position of the current moment on the time axis."""
    if not history:
        return "nothing has come yet"
    index, count = moment_index(state, history), len(history)
    shown = state.held if state.held is not None else history[-1]
    ago = history[-1].received_s - shown.received_s
    newer = count - 1 - index
    place = f"snapshot {index + 1} of {count}"
    return f"{place}, {ago:.0f} s before the newest" if newer else f"{place}, the newest"


def feed_line(age_s: float | None, final: bool) -> str:
    """How the connection is; `age_s` is None for a result on disk, infinite before anything came."""
    if age_s is None:
        return "a finished result" if final else "a result that was not final"
    if age_s == float("inf"):
        return "waiting for splatnode recon: nothing has come yet"
    if final:
        return "the scene is finished"
    if age_s > _STALE_S:
        return f"STALE: nothing has come for {age_s:.0f} s"
    return "live"


def waiting_line(age_s: float | None) -> str:
    """Describes the state of the feed before there is a scene."""
    if age_s is not None and age_s <= _STALE_S:
        return "splatnode recon is there: waiting for its first scene"
    return feed_line(age_s, final=False)


def thousands(number: int) -> str:
    """12345 as "12 345"."""
    return f"{number:,}".replace(",", " ")
