"""`python -m tests.golden [--out FILE] [--check FILE]`: do results stay the same, byte for byte?

Reconstructs known captures with seed 0 and prints the sha256 of each scene.ply and cameras.json; so it does for a live
walk over two rendered places, and for the same walk where the node is killed in its middle. Run it with --out
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
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path

import msgspec
import yaml

from splatnode.capture.frame import Frame
from splatnode.capture.messaging.messages import ReceivedFrame
from splatnode.capture.messaging.network import Network
from splatnode.capture.status import read_heartbeats
from splatnode.recon.daemon.checkpoint import Store
from tests.support.synthetic import SMALL, places

SCENES = Path("../shared/scenes")
FILES = ("scene.ply", "cameras.json")
# Name, and what follows `splatnode` on the command line, before --out
BUILT_IN = (("built-in capture", ("demo", "--seed", "0")),)
REAL = (("fountain_p11", 6), ("llff_flower", 3), ("fox", 12))
WALK = msgspec.structs.replace(SMALL, views=8)  # four views of each of two places
BEFORE = 7  # keyframes of the walk that come before the node is killed: all but one
PATIENCE_S = 600.0
RESTING = ("idle", "waiting", "lost")  # states in which a node works on nothing


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


def hash_walk(kill: bool) -> dict[str, str]:
    """Runs a node over a walk and returns the sha256 of the files of its places, in their order.

    If `kill`, the node is killed once it is at rest with the first keyframes, and another one goes on.
    Raises subprocess.CalledProcessError or TimeoutError where it fails.
    """
    frames = places(WALK)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "run").mkdir(mode=0o700)
        config = {"network": {"directory": str(folder / "run")}, "checkpoint": str(folder / "kept")}
        config |= {"out": str(folder / "out"), "reconstruction": {"seed": 0}, "status_interval_s": 0.2}
        (folder / "recon.yaml").write_text(yaml.safe_dump(config))
        command = [sys.executable, "-m", "splatnode", "recon", str(folder / "recon.yaml")]
        store_keyframes(folder / "kept", frames, range(BEFORE if kill else len(frames)))
        if kill:
            node = subprocess.Popen(command, stdout=subprocess.DEVNULL)
            try:
                wait_until_at_rest(Network(directory=folder / "run"))
            finally:
                node.kill()
                node.wait()
            store_keyframes(folder / "kept", frames, range(BEFORE, len(frames)))
        subprocess.run([*command, "--finish"], check=True, stdout=subprocess.DEVNULL, timeout=PATIENCE_S)
        found = sorted(path.parent for path in (folder / "out").glob("scene-*/scene.ply"))
        return {
            f"place {number} {file}": hashlib.sha256((place / file).read_bytes()).hexdigest()
            for number, place in enumerate(found, start=1)
            for file in FILES
        }


def store_keyframes(checkpoint: Path, frames: Sequence[Frame], numbers: Sequence[int]) -> None:
    """Stores keyframes as a node does that has acknowledged them and worked in none."""
    with closing(Store(checkpoint)) as store:
        for number in numbers:
            store.add_frame(ReceivedFrame("0" * 32, number, frames[number]))


def wait_until_at_rest(network: Network) -> None:
    """Raises TimeoutError where the node still works after `PATIENCE_S`."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        status = read_heartbeats(network, 1.0)["recon"]
        if status is not None and status["state"] in RESTING and not status["unfinished"] and status["final"]:
            return
    raise TimeoutError(f"the node was not at rest after {PATIENCE_S:.0f} s")


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
    for name, kill in (("live walk", False), ("live walk, killed in its middle", True)):
        found[name] = hash_walk(kill)
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
