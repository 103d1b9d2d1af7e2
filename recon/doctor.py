"""What is installed here and what is missing: `splatnode doctor`. Every line was found out, none is assumed."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import shutil
import sys
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

from splatnode.capture.cameras import v4l2
from splatnode.capture.messaging import keyframe_queue
from splatnode.capture.messaging.network import Network, runtime_directory
from splatnode.capture.process.system import EXTRAS, REQUIRED
from splatnode.capture.process.terminal import say, show_progress, show_waiting
from splatnode.recon import core
from splatnode.recon.core.compile import find_compiler

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
    from splatnode.recon import rates  # brings what reconstructs

    views = args.rates or rates.VIEWS
    with show_progress(quiet=args.json) as tell:
        found = rates.measure_rates(views, tell=tell)
    if args.json:
        print(json.dumps(rates.record_rates(found), indent=1))
        return 0
    for line in rates.format_rates(found):
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
