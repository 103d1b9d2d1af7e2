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
from concurrent.futures import ThreadPoolExecutor
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
    "aarch64": {"baseline": []},
}


def machine() -> str:
    """The processor family in the spelling of `INSTRUCTION_SETS`."""
    name = platform.machine().lower()
    return {"amd64": "x86_64", "arm64": "aarch64"}.get(name, name)


def library_path(instruction_set: str) -> Path:
    return HERE / f"_core_{machine()}_{instruction_set}.so"


def find_compiler() -> list[str] | None:
    """The command of a C++ compiler, or None: $CXX, g++, clang++, c++, then ziglang from PyPI."""
    for name in (os.environ.get("CXX"), "g++", "clang++", "c++"):
        if name and shutil.which(name.split()[0]):
            return name.split()
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "c++"]
    return None


def platform_tag() -> str:
    """The platform of a wheel that carries the libraries, for example linux_x86_64.

    Zig compiles against an old glibc of choice and links its own C++ library, so its libraries run on any Linux of
    the last ten years; those of another compiler are promised only to machines like this one.
    """
    platform_name = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    if platform_name.startswith("linux") and _is_zig(find_compiler() or []):
        return f"manylinux_{OLDEST_GLIBC.replace('.', '_')}_{machine()}"
    return platform_name


def compile_core(force: bool = False) -> list[Path]:
    """Compiles what is out of date and returns the libraries' paths.

    Raises RuntimeError when there is no compiler (naming the command that installs one) or when compilation fails.
    """
    compiler = find_compiler()
    if compiler is None:
        raise RuntimeError(
            "no C++ compiler found (looked for $CXX, g++, clang++, c++ and the Python package ziglang). "
            "Run: pip install ziglang"
        )
    sources = sorted(HERE.glob("*.cpp"))
    digest = _digest(compiler, sources + sorted(HERE.glob("*.h")))
    instruction_sets = INSTRUCTION_SETS.get(machine(), {"baseline": []})
    stale = [name for name in instruction_sets if force or not _is_current(library_path(name), digest)]
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as compilers, ThreadPoolExecutor() as linkers:
        built = [
            linkers.submit(_build, compilers, compiler, sources, library_path(name), instruction_sets[name], digest)
            for name in stale
        ]
        for job in built:
            job.result()
    return [library_path(name) for name in instruction_sets]


def _is_current(library: Path, digest: str) -> bool:
    stamp = library.with_suffix(".stamp")
    return library.exists() and stamp.exists() and stamp.read_text() == digest


def _digest(compiler: list[str], files: list[Path]) -> str:
    """Changes when a library would. Zig is the same wherever it is installed (a build environment, a virtual one)."""
    command = ["ziglang"] if _is_zig(compiler) else compiler
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
    if _is_zig(compiler):
        flags = _zig_flags(flags)
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
    return "ziglang" in compiler


def _zig_flags(flags: list[str]) -> list[str]:
    """Zig spells processors its own way and, without one, compiles for the processor that it runs on."""
    target = [f"--target={machine()}-linux-gnu.{OLDEST_GLIBC}"] if sys.platform == "linux" else []
    processor = [] if any(flag.startswith("-march=") for flag in flags) else ["-mcpu=baseline"]
    return target + processor + [flag.replace("-march=x86-64-v", "-mcpu=x86_64_v") for flag in flags]


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
