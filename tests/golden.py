"""`python -m tests.golden [--out FILE] [--check FILE]`: do results stay the same, byte for byte?

Reconstructs known captures with seed 0 and prints the sha256 of each scene.ply and cameras.json. Run it with --out
before a change that must not change any result, and with --check after it: 0 where all are equal, 1 where one is not.
The sums are those of one machine: another instruction set or another PyTorch gives others. Captures of
../shared/scenes are reconstructed where they are present.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

SCENES = Path("../shared/scenes")
FILES = ("scene.ply", "cameras.json")
# Name, and what follows `splatnode` on the command line, before --out
BUILT_IN = (("built-in capture", ("demo", "--seed", "0")),)
REAL = (("fountain_p11", 6), ("llff_flower", 3), ("fox", 12))


def list_cases(scenes: Path) -> Iterator[tuple[str, Sequence[str]]]:
    """Yields the name and the command of each capture; real ones only where `scenes` has them."""
    yield from BUILT_IN
    for scene, count in REAL:
        images = sorted(path for path in (scenes / scene).glob("*/*") if path.suffix.lower() in (".jpg", ".png"))
        images = images or sorted(path for path in (scenes / scene).glob("*.[jp][pn]g"))
        if images:
            chosen = [images[index * len(images) // count] for index in range(count)]
            yield f"{scene} {count}", ("replay", *map(str, chosen), "--seed", "0")


def hash_results(command: Sequence[str]) -> dict[str, str]:
    """Runs `splatnode` in a process of its own and returns the sha256 of the files that it wrote.

    Raises subprocess.CalledProcessError where it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        subprocess.run(
            [sys.executable, "-m", "splatnode", *command, "--out", str(out)], check=True, stdout=subprocess.DEVNULL
        )
        return {name: hashlib.sha256((out / name).read_bytes()).hexdigest() for name in FILES if (out / name).exists()}


def report_differences(found: Mapping[str, Mapping[str, str]], known: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Returns one line for each file whose sum differs; captures that only one of both has do not count."""
    return [
        f"{case}: {name} was {known[case].get(name, 'absent')[:12]}, is {found[case].get(name, 'absent')[:12]}"
        for case in found
        if case in known
        for name in sorted({*found[case], *known[case]})
        if found[case].get(name) != known[case].get(name)
    ]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__)
    parser.add_argument("--out", type=Path, metavar="FILE", help="where to write the sums as JSON")
    parser.add_argument("--check", type=Path, metavar="FILE", help="sums to compare with, from --out")
    arguments = parser.parse_args()
    found = {}
    for name, command in list_cases(SCENES):
        found[name] = hash_results(command)
        print(name, *(f"{file} {digest[:16]}" for file, digest in found[name].items()), flush=True)
    if arguments.out:
        arguments.out.write_text(json.dumps(found, indent=1) + "\n")
    if not arguments.check:
        return 0
    different = report_differences(found, json.loads(arguments.check.read_text()))
    print("\n".join(different) or "all equal")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
