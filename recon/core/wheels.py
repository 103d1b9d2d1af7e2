"""Wheels for other machines, from this one: `./run wheels [--out DIR] [TARGET ...]`.

Zig compiles the core for each target with all its instruction sets; a copy of the project with those libraries, and no
others, goes through the build backend. Wheels are tied to a platform but to no version of Python.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from splatnode.capture.process import python
from splatnode.recon.core.compile import HERE, TARGETS

ROOT = HERE.parents[1]
_PACKED = ("capture", "configs", "recon", "splatnode", "viewer", "pyproject.toml", "README.md", "LICENSE")
FROM_COPY = "import sys; sys.path.insert(0, sys.argv[1])"  # of the project, whose backend is the one that builds
_BUILD = f"""
{FROM_COPY}
from splatnode.recon.core import backend
print(backend.build_wheel(sys.argv[2], {{"target": sys.argv[3]}}))
"""


def build_wheel(target: str, out: Path) -> Path:
    """The wheel for one of TARGETS, in the folder `out`. Raises RuntimeError where it cannot be built, with the reason.

    It needs setuptools and ziglang in this environment, and the project's own folder: an installed package will not do.
    """
    if not (ROOT / "pyproject.toml").exists():
        raise RuntimeError(f"{ROOT} is not the project's folder: wheels are built from a checkout or an sdist")
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="splatnode-wheel-") as folder:
        for name in _PACKED:
            _copy(ROOT / name, Path(folder) / name)
        command = python.make_isolated_command("-c", _BUILD, folder, str(out.resolve()), target)
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if result.returncode != 0:
        raise RuntimeError(f"the wheel for {target} was not built:\n{result.stderr[-4000:]}")
    return out / result.stdout.splitlines()[-1]


def _copy(source: Path, to: Path) -> None:
    """Without what was compiled for this machine."""
    if source.is_dir():
        shutil.copytree(source, to, symlinks=True, ignore=shutil.ignore_patterns("_core_*", "__pycache__", ".build-*"))
    else:
        shutil.copy2(source, to)


def parse_arguments(verb: str, description: str | None, argv: Sequence[str] | None) -> tuple[list[str], Path]:
    """The targets, all by default, and the folder that the arguments of `./run VERB` name."""
    parser = argparse.ArgumentParser(prog=f"./run {verb}", description=description)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"some of {', '.join(TARGETS)} (default: all)")
    parser.add_argument("--out", type=Path, default=Path("dist"), metavar="DIR", help="default: dist")
    args = parser.parse_args(argv)
    if unknown := set(args.targets) - set(TARGETS):
        parser.error(f"no target {', '.join(sorted(unknown))}; there are: {', '.join(TARGETS)}")
    return args.targets or list(TARGETS), args.out


def main(argv: Sequence[str] | None = None) -> int:
    """Builds the wheels that are asked for, and prints their paths; 1 where one could not be built."""
    targets, out = parse_arguments("wheels", __doc__, argv)
    failed = 0
    for target in targets:
        try:
            print(build_wheel(target, out), flush=True)
        except RuntimeError as error:
            print(error, file=sys.stderr)
            failed = 1
    return failed


if __name__ == "__main__":
    sys.exit(main())
