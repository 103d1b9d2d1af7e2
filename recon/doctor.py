"""What is installed here and what is missing: `splatnode doctor`. Every line was found out, none is assumed."""

from __future__ import annotations

import argparse
import importlib.util
import json
import platform
import sys
from dataclasses import asdict, dataclass
from importlib import metadata

from recon import core
from recon.core.compile import find_compiler

# Import name -> distribution.
REQUIRED = {
    "cv2": "opencv-contrib-python-headless",
    "msgpack": "msgpack",
    "msgspec": "msgspec",
    "numpy": "numpy",
    "poselib": "poselib",
    "pycolmap": "pycolmap",
    "scipy": "scipy",
    "torch": "torch",
    "yaml": "pyyaml",
    "zmq": "pyzmq",
}

# Import name -> (distribution, the extra that brings it, what it is for).
OPTIONAL = {
    "matplotlib": ("matplotlib", "bench", "charts of splatnode bench"),
    "open3d": ("open3d", "viewer", "the viewer"),
    "depthai": ("depthai", "oak", "Luxonis cameras"),
    "gsplat": ("gsplat", "cuda", "the rasteriser for NVIDIA processors"),
}


@dataclass(frozen=True)
class Finding:
    name: str
    state: str  # "ok"; "missing": nothing works without it; "optional": not there, and only what `detail` says needs it
    detail: str


def doctor(args: argparse.Namespace) -> int:
    """Prints the findings; 2 when something is missing that everything needs."""
    found = findings()
    if args.json:
        print(json.dumps([asdict(finding) for finding in found], indent=1))
    else:
        for finding in found:
            print(f"{finding.state:9}{finding.name:12}{finding.detail}")
    return 2 if any(finding.state == "missing" for finding in found) else 0


def findings() -> list[Finding]:
    return [
        _machine(),
        _compiler(),
        _core(),
        *(_required(module, distribution) for module, distribution in REQUIRED.items()),
        *(_optional(module, *about) for module, about in OPTIONAL.items()),
        *(_lpips(network) for network in ("alex", "vgg")),
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


def _required(module: str, distribution: str) -> Finding:
    if importlib.util.find_spec(module):
        return Finding(module, "ok", _version(distribution))
    return Finding(module, "missing", f"Run: pip install {distribution}")


def _optional(module: str, distribution: str, extra: str, purpose: str) -> Finding:
    if importlib.util.find_spec(module):
        return Finding(module, "ok", _version(distribution))
    return Finding(module, "optional", f"not installed; for {purpose} (the extra named {extra} brings it)")


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return f"installed, though not from {distribution}"


def _lpips(network: str) -> Finding:
    """Loads the network, because a file of that name may hold something else."""
    name = f"lpips-{network}"
    try:
        from recon.losses.lpips import load_lpips

        loaded = load_lpips(network)
    except (ImportError, OSError, ValueError) as error:
        return Finding(name, "optional", f"not measured: {error}")
    if loaded is None:
        return Finding(name, "optional", "no weights (looked in $SPLATNODE_WEIGHTS); splatnode bench leaves it out")
    return Finding(name, "ok", "weights found and loaded")
