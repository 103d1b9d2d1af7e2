"""What is installed here and what is missing: `splatnode doctor`. Every line was found out, none is assumed."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from splatnode.capture.cameras import synthetic, v4l2
from splatnode.capture.messaging import keyframe_queue
from splatnode.capture.messaging.network import Network, runtime_directory
from splatnode.capture.process.system import EXTRAS, REQUIRED
from splatnode.capture.process.terminal import Tell, ignore_progress, say, show_progress, show_waiting
from splatnode.recon import core
from splatnode.recon.core.compile import find_compiler

if TYPE_CHECKING:
    from splatnode.recon.config import ReconstructionConfig
    from splatnode.recon.locating import Located, NotLocated
    from splatnode.recon.result.snapshot import Landmarks

_UDEV_RULES = Path("/etc/udev/rules.d")

OPTIONAL = {  # Import name, which is the distribution's too -> what it is for.
    "matplotlib": "charts of splatnode bench",
    "pycolmap": "true cameras in COLMAP's format, and COLMAP as a rival",
    "open3d": "the viewer",
    "pyarrow": "the table of splatnode batch as Parquet",
    "depthai": "Luxonis cameras",
    "pi_heif": "photographs in HEIC and AVIF",
    "gsplat": "the rasteriser for NVIDIA processors",
}


@dataclass(frozen=True)
class Finding:
    name: str
    state: str  # "ok"; "missing": nothing works without it; "optional": not there, and only what `detail` says needs it
    detail: str


def doctor(args: argparse.Namespace) -> int:
    """Prints the findings, or the rates that are asked for; 2 when something is missing that everything needs."""
    if args.rates is not None:
        return _print_rates(args)
    with show_waiting("looking at what is installed"):
        found = findings()
    if args.json:
        print(json.dumps([asdict(finding) for finding in found], indent=1))
    else:
        for finding in found:
            say(f"{finding.state:9}{finding.name:14}{finding.detail}")
    return 2 if any(finding.state == "missing" for finding in found) else 0


def _print_rates(args: argparse.Namespace) -> int:
    """Prints the seconds of each step with each number of views. Raises ValueError for a wrong number."""
    views = args.rates or VIEWS
    with show_progress(quiet=args.json) as tell:
        found = measure_rates(views, tell=tell)
    if args.json:
        print(json.dumps(record_rates(found), indent=1))
        return 0
    for line in format_rates(found):
        say(line)
    say(f"The built-in capture, {core.default_threads()} threads, {core.instruction_sets()[0]}, preset balanced.")
    return 0


def findings() -> list[Finding]:
    return [
        _machine(),
        _compiler(),
        _core(),
        *(_check_required(module, distribution) for module, distribution in REQUIRED.items()),
        _poselib(),
        _gpu(),
        *(_check_optional(module, purpose) for module, purpose in OPTIONAL.items()),
        *(_lpips(network) for network in ("alex", "vgg")),
        *_check_learned_parts(),
        _cameras(),
        *_oak_rights(),
        _network(),
        _spool(),
    ]


def _machine() -> Finding:
    system = f"{platform.system()} {platform.machine()}, {core.default_threads()} threads"
    state = "ok" if sys.version_info >= (3, 10) else "missing"
    return Finding("machine", state, f"Python {platform.python_version()}, {system}")


def _compiler() -> Finding:
    compiler = find_compiler()
    if compiler:
        return Finding("compiler", "ok", " ".join(compiler))
    return Finding("compiler", "optional", "none; needed only to compile the core. Run: pip install ziglang")


def _core() -> Finding:
    """Loads the library, which is the only proof that it can be used."""
    try:
        core.library()
    except (RuntimeError, OSError) as error:
        return Finding("core", "missing", str(error))
    usable = core.instruction_sets()
    return Finding("core", "ok", f"{usable[0]} (can also run: {', '.join(usable[1:]) or 'no other'})")


def _check_required(module: str, distribution: str) -> Finding:
    if importlib.util.find_spec(module):
        return Finding(module, "ok", _version(distribution))
    return Finding(module, "missing", f"Run: pip install {distribution}")


def _check_optional(module: str, purpose: str) -> Finding:
    if importlib.util.find_spec(module):
        return Finding(module, "ok", _version(module))
    return Finding(module, "optional", f"not installed; for {purpose} (the extra named {EXTRAS[module]} brings it)")


def _poselib() -> Finding:
    if importlib.util.find_spec("poselib"):
        return Finding("poselib", "ok", _version("poselib"))
    return Finding(
        "poselib", "optional", "not installed (it has no wheel for Linux on aarch64): OpenCV finds the poses"
    )


def _gpu() -> Finding:
    """Whether Gaussians can be refined on a GPU: the answer of those who would do it."""
    try:
        from splatnode.recon.rasterize import choose_device, format_device

        device = choose_device("auto")
    except (ImportError, OSError) as error:
        return Finding("gpu", "optional", f"not examined: {error}")
    return Finding("gpu", "ok" if device.type == "cuda" else "optional", format_device("auto", device))


def _cameras() -> Finding:
    """Opens each, as capture would."""
    found = v4l2.find()
    if not found:
        return Finding("cameras", "optional", "no webcam is connected; folders, recordings and videos need none")
    listed = "; ".join(f"{camera['device']} {camera['description']}" for camera in found)
    shut = any("cannot be opened" in camera["description"] for camera in found)
    return Finding("cameras", "optional" if shut else "ok", listed + ("; join the group video" if shut else ""))


def _oak_rights() -> list[Finding]:
    """Whether an OAK camera may be opened by this user; of no interest without the package."""
    if not importlib.util.find_spec("depthai"):
        return []
    rules = [path for path in _UDEV_RULES.glob("*.rules") if "03e7" in path.read_text(errors="replace")]
    if rules or os.geteuid() == 0:
        return [Finding("oak rights", "ok", str(rules[0]) if rules else "this user may open every device")]
    advice = (
        "no udev rule for OAK cameras; run splatnode config --write configs, "
        "then copy configs/udev/80-splatnode-oak.rules to /etc/udev/rules.d"
    )
    return [Finding("oak rights", "optional", advice)]


def _network() -> Finding:
    """Checks the default folder of the sockets."""
    try:
        return Finding("sockets", "ok", str(runtime_directory(Network())))
    except OSError as error:
        return Finding("sockets", "missing", f"capture, recon and view cannot meet: {error}")


def _spool() -> Finding:
    """Room for keyframes that wait."""
    config = keyframe_queue.SpoolConfig()
    try:
        directory = keyframe_queue.spool_directory(config)
    except ValueError as error:
        return Finding("spool", "missing", f"capture cannot keep keyframes: {error}")
    there = next(folder for folder in (directory, *directory.parents) if folder.exists())
    if not os.access(there, os.W_OK):
        return Finding("spool", "missing", f"capture cannot keep keyframes: {there} cannot be written to")
    free_mb = shutil.disk_usage(there).free >> 20
    state = "ok" if free_mb > config.max_mb else "optional"
    detail = f"{directory}, {len(list(directory.glob('*.frame')))} keyframes wait, {free_mb} MB free"
    return Finding("spool", state, detail if state == "ok" else f"{detail}; {config.max_mb} MB may be needed")


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return f"installed, though not from {distribution}"


def _check_learned_parts() -> list[Finding]:
    """Whether each learned part is ready; one that is not costs nothing but itself."""
    try:
        from splatnode.recon.fallbacks import find_unavailable_reason, list_learned_parts

        parts = list_learned_parts()
    except (ImportError, OSError) as error:
        return [Finding("learned parts", "optional", f"not examined: {error}")]
    found = []
    for part in parts:
        try:
            hindered = find_unavailable_reason(part)
        except ValueError as error:
            hindered = str(error)
        detail = f"{part.purpose}; weights: {part.licence}"
        found.append(Finding(part.name, "optional" if hindered else "ok", f"{hindered or 'ready'}; {detail}"))
    return found


def _lpips(network: str) -> Finding:
    """Loads the network, because a file of that name may hold something else."""
    name = f"lpips-{network}"
    try:
        from splatnode.recon.networks.lpips import load_lpips

        loaded = load_lpips(network)
    except (ImportError, OSError, ValueError) as error:
        return Finding(name, "optional", f"not measured: {error}")
    if loaded is None:
        return Finding(name, "optional", "no weights (looked in $SPLATNODE_WEIGHTS); splatnode bench leaves it out")
    return Finding(name, "ok", "weights found and loaded")


# How long each step of a growing scene takes on this machine: `splatnode doctor --rates [VIEWS ...]`.
#
# The steps are those of a node and of `splatnode.Session`, measured on the built-in capture: the last image is added
# and the scene updated with it, a query image is localized, all is finalized, and the final scene becomes a map.

VIEWS = (3, 6, 12)
FEWEST, MOST = 2, 48
_QUERIES = 5  # localized images, at most: the median counts

Made = TypeVar("Made")


@dataclass(frozen=True)
class Rates:
    """Seconds of each step of a scene with so many views; None for what was not possible."""

    views: int
    add_s: float  # features and matches of the last image
    update_s: float  # the scene with it
    localize_s: float | None  # a query image, anywhere in the final scene: the median
    localized: str  # how many of the query images were localized: "5 of 5"
    finalize_s: float  # all evidence, and the refined scene
    map_s: float | None  # which space is free; None too where the cameras are too rough for a map
    verdict: str
    gaussians: int


def measure_rates(
    views: Sequence[int] = VIEWS, config: ReconstructionConfig | None = None, tell: Tell = ignore_progress
) -> list[Rates]:
    """Measures the seconds of each step for each number of views. Raises ValueError for less than 2 or more than 48."""
    from splatnode.recon.config import ReconstructionConfig  # brings what reconstructs

    wrong = [count for count in views if not FEWEST <= count <= MOST]
    if wrong or not views:
        raise ValueError(
            f"--rates must be numbers of views from {FEWEST} to {MOST}, got {wrong[0] if wrong else 'none'}"
        )
    config = config or ReconstructionConfig()
    _measure(FEWEST, config, ignore_progress)  # loads what is loaded once
    return [_measure(count, config, tell) for count in views]


def record_rates(found: Sequence[Rates]) -> dict[str, object]:
    """The rates and the machine, for --json."""
    machine = {"threads": core.default_threads(), "instruction_set": core.instruction_sets()[0]}
    command = f"splatnode doctor --rates {' '.join(str(each.views) for each in found)} --json"
    return {"command": command, "machine": machine, "rates": [asdict(each) for each in found]}


def format_rates(found: Sequence[Rates]) -> list[str]:
    """A table for people, a line for each number of views."""
    titles = ("views", "add", "update", "localize", "finalize", "map")
    rows = [
        (
            str(each.views),
            *map(_format_seconds, (each.add_s, each.update_s, each.localize_s, each.finalize_s, each.map_s)),
        )
        for each in found
    ]
    return ["".join(text.rjust(10) for text in row) for row in (titles, *rows)]


def _measure(count: int, config: ReconstructionConfig, tell: Tell) -> Rates:
    from splatnode.recon.incremental import IncrementalReconstruction  # brings what reconstructs
    from splatnode.recon.locating import Located
    from splatnode.recon.occupancy import NoMap, occupancy_map
    from splatnode.recon.pipeline import rebuild_from_scratch

    tell(f"measuring a scene of {count} views")
    capture = synthetic.Config(views=count)
    work = IncrementalReconstruction(config)
    *before, last = synthetic.stream(capture)
    for frame in before:
        work.add_frame(frame)
        work.update()
    add_s, _ = _time(lambda: work.add_frame(last))
    update_s, _ = _time(work.update)
    finalize_s, (*_, snapshot) = _time(lambda: list(rebuild_from_scratch(work)))
    tried = _localize(capture, snapshot.landmarks)
    map_s = None
    with suppress(NoMap):
        map_s, _ = _time(lambda: occupancy_map(snapshot))
    return Rates(
        views=count,
        add_s=add_s,
        update_s=update_s,
        localize_s=float(np.median([seconds for seconds, _ in tried])) if tried else None,
        localized=f"{sum(isinstance(outcome, Located) for _, outcome in tried)} of {len(tried)}",
        finalize_s=finalize_s,
        map_s=map_s,
        verdict=snapshot.verdict.code.value,
        gaussians=len(snapshot.gaussians),
    )


def _localize(capture: synthetic.Config, landmarks: Landmarks | None) -> list[tuple[float, Located | NotLocated]]:
    """Seconds and outcomes of query images between those of the scene; none where there is no scene."""
    from splatnode.recon.locating.localize import localize_image  # brings what matches photographs

    if landmarks is None:
        return []
    queries = synthetic.evaluation_cameras(capture)[:_QUERIES]
    images = [synthetic.render_image(capture, camera) for camera in queries]
    return [_time(partial(localize_image, landmarks, image, None)) for image in images]


def _time(work: Callable[[], Made]) -> tuple[float, Made]:
    began = time.perf_counter()
    made = work()
    return time.perf_counter() - began, made


def _format_seconds(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds:.2f} s"
