"""Compiles the C++ core into one shared library per instruction set: `python recon/core/compile.py`.

The core is plain C++17 without dependencies, so any recent g++ or clang++ will do; where neither is installed the
compiler that PyPI carries as `ziglang` is used. Nothing is compiled when sources, flags and compiler are those of the
last time.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent

# Reassociation lets sums use vector lanes. NaN and infinity keep their meaning (no -ffinite-math-only), because the
# core checks its input for them, and the flags are never given to the linker: there they would change the rounding
# mode of the whole process.
FLAGS = [
    "-O3", "-std=c++17", "-fPIC", "-pthread", "-fvisibility=hidden",
    "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math", "-freciprocal-math",
    "-ffp-contract=fast",
]  # fmt: skip
LINK_FLAGS = ["-shared", "-pthread", "-s"]

OLDEST_GLIBC = "2.17"  # what Zig compiles against: that of manylinux2014

# Best first. The loader takes the first one that the processor can run.
INSTRUCTION_SETS = {
    "x86_64": {
        "avx512": ["-march=x86-64-v4", "-mprefer-vector-width=512"],
        "avx2": ["-march=x86-64-v3"],
        "baseline": [],
    },
    "aarch64": {
        "neon_dotprod": ["-march=armv8.2-a+dotprod"],  # Raspberry Pi 5, Jetson Orin, Apple's
        "neon": [],
    },
}


@dataclass(frozen=True)
class Target:
    """A kind of machine, other than this one perhaps, that Zig compiles the core for."""

    machine: str  # of INSTRUCTION_SETS
    zig: str  # as Zig names it, with the oldest version of its system
    platform: str  # as a wheel's name ends


TARGETS = {
    "linux-x86_64": Target("x86_64", f"x86_64-linux-gnu.{OLDEST_GLIBC}", "manylinux_2_17_x86_64"),
    "linux-aarch64": Target("aarch64", f"aarch64-linux-gnu.{OLDEST_GLIBC}", "manylinux_2_17_aarch64"),
    "macos-arm64": Target("aarch64", "aarch64-macos.11.0", "macosx_11_0_arm64"),
}


def machine() -> str:
    """The processor family in the spelling of `INSTRUCTION_SETS`."""
    name = platform.machine().lower()
    return {"amd64": "x86_64", "arm64": "aarch64"}.get(name, name)


def library_path(instruction_set: str, of_machine: str | None = None) -> Path:
    """Returns the path of the library for an instruction set of this machine, or of another."""
    return HERE / f"_core_{of_machine or machine()}_{instruction_set}.so"


def find_compiler() -> list[str] | None:
    """The command of a C++ compiler, or None: $CXX, g++, clang++, c++, then ziglang from PyPI."""
    for name in (os.environ.get("CXX"), "g++", "clang++", "c++"):
        if name and shutil.which(name.split()[0]):
            return name.split()
    return find_zig()


def find_zig() -> list[str] | None:
    """The command of the C++ compiler that PyPI carries, which compiles for every target, or None."""
    found = importlib.util.find_spec("ziglang")
    return [str(Path(found.origin).with_name("zig")), "c++"] if found and found.origin else None  # as its -m does


def platform_tag(target: Target | None = None) -> str:
    """The platform of a wheel that carries the libraries for this machine, or for `target`: linux_x86_64, say.

    Zig compiles against an old glibc of choice and links its own C++ library, so its libraries run on any Linux of
    the last ten years; those of another compiler are promised only to machines like this one.
    """
    if target is not None:
        return target.platform
    platform_name = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    if platform_name.startswith("linux") and _is_zig(find_compiler() or []):
        return f"manylinux_{OLDEST_GLIBC.replace('.', '_')}_{machine()}"
    return platform_name


def compile_core(force: bool = False, target: Target | None = None) -> list[Path]:
    """Compiles what is out of date, for this machine or with Zig for `target`, and returns the libraries' paths.

    Raises RuntimeError when there is no compiler (naming the command that installs one) or when compilation fails.
    """
    compiler = find_compiler() if target is None else find_zig()
    if compiler is None:
        looked_for = "$CXX, g++, clang++, c++ and the Python package ziglang" if target is None else "ziglang"
        raise RuntimeError(f"no C++ compiler found (looked for {looked_for}). Run: pip install ziglang")
    family = machine() if target is None else target.machine
    instruction_sets: Mapping[str, list[str]] = INSTRUCTION_SETS.get(family, {"baseline": []})
    paths = {name: library_path(name, family) for name in instruction_sets}
    sources = sorted(HERE.glob("*.cpp"))
    digest = _digest([*compiler, *([] if target is None else [target.zig])], sources + sorted(HERE.glob("*.h")))
    stale = [name for name in paths if force or not _is_current(paths[name], digest)]
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as compilers, ThreadPoolExecutor() as linkers:
        flags = {name: _flags(compiler, instruction_sets[name], target) for name in stale}
        built = [
            linkers.submit(_build, compilers, compiler, sources, paths[name], flags[name], digest) for name in stale
        ]
        for job in built:
            job.result()
    return list(paths.values())


def _flags(compiler: list[str], flags: list[str], target: Target | None) -> list[str]:
    return _zig_flags(flags, target) if _is_zig(compiler) else flags


def _is_current(library: Path, digest: str) -> bool:
    stamp = library.with_suffix(".stamp")
    return library.exists() and stamp.exists() and stamp.read_text() == digest


def _digest(compiler: list[str], files: list[Path]) -> str:
    """Changes when a library would. Zig is the same wherever it is installed (a build environment, a virtual one)."""
    command = ["ziglang", *compiler[1:]] if _is_zig(compiler) else compiler
    digest = hashlib.sha256(repr((command, FLAGS, LINK_FLAGS, INSTRUCTION_SETS, OLDEST_GLIBC)).encode())
    for path in files:
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def _build(
    compilers: ThreadPoolExecutor,
    compiler: list[str],
    sources: list[Path],
    library: Path,
    flags: list[str],
    digest: str,
) -> None:
    """One library, which replaces the one that is there when it is whole. Sources are compiled by `compilers`."""
    with tempfile.TemporaryDirectory(prefix=".build-", dir=HERE) as folder:
        objects = [Path(folder) / f"{source.stem}.o" for source in sources]
        jobs = [
            compilers.submit(_run, [*compiler, *FLAGS, *flags, "-c", str(source), "-o", str(output)])
            for source, output in zip(sources, objects, strict=True)
        ]
        for job in jobs:
            job.result()
        unfinished = Path(folder) / library.name
        target = [flag for flag in flags if flag.startswith("--target=")]
        _run([*compiler, *LINK_FLAGS, *target, *map(str, objects), "-o", str(unfinished)])
        os.replace(unfinished, library)
    library.with_suffix(".stamp").write_text(digest)


def _is_zig(compiler: list[str]) -> bool:
    return any("ziglang" in (part, Path(part).parent.name) for part in compiler)


def _zig_flags(flags: list[str], target: Target | None = None) -> list[str]:
    """Zig spells processors its own way and, without one, compiles for the processor that it runs on."""
    own = f"{machine()}-linux-gnu.{OLDEST_GLIBC}" if sys.platform == "linux" else None
    system = own if target is None else target.zig
    processor = [] if any(flag.startswith("-march=") for flag in flags) else ["-mcpu=baseline"]
    spelled = {"-march=x86-64-v": "-mcpu=x86_64_v", "-march=armv8.2-a+": "-mcpu=generic+v8_2a+"}
    for ours, zigs in spelled.items():
        flags = [flag.replace(ours, zigs) for flag in flags]
    return ([f"--target={system}"] if system else []) + processor + flags


def _run(command: list[str]) -> None:
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode != 0:
        raise RuntimeError(f"the C++ core did not compile: {' '.join(command)}\n{result.stderr[-4000:]}")


if __name__ == "__main__":
    if "--find-compiler" in sys.argv:
        sys.exit(find_compiler() is None)
    try:
        for built_library in compile_core(force="--force" in sys.argv):
            print(built_library.name)
    except RuntimeError as error:
        sys.exit(str(error))
