"""A folder of photographs that also holds Python modules: whoever runs one of them leaves a trace."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import splatnode

PACKAGE_ROOT = str(Path(splatnode.__file__).parents[1])
MODULES = (
    "splatnode", "torch", "numpy", "cv2", "scipy", "msgspec", "av", "yaml", "zmq", "sitecustomize", "usercustomize",
    "site", "json", "typing", "argparse", "pickle", "runpy", "capture", "recon", "gsplat", "open3d", "depthai",
)  # fmt: skip
_SCRIPT = "import sys\nfrom splatnode.command_line import main\nsys.exit(main())\n"


def make_hostile(folder: Path) -> Path:
    """The modules, in `folder`; returns the file in which those that were run are listed."""
    folder.mkdir(parents=True, exist_ok=True)
    trace = folder / "trace"
    for name in MODULES:
        (folder / f"{name}.py").write_text(f"open({str(trace)!r}, 'a').write('{name} ')\n")
    return trace


def program(folder: Path) -> list[str]:
    """The command line as an installed one: a script in `folder`, which is no folder of photographs."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "splatnode").write_text(_SCRIPT)
    return [sys.executable, str(folder / "splatnode")]


def variables() -> dict[str, str]:
    """The environment of a user who has this splatnode by $PYTHONPATH, and a program that adds the current folder."""
    return {**os.environ, "PYTHONPATH": PACKAGE_ROOT}
