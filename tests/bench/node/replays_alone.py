"""`splatnode replay` of each folder in a folder, alone: `... IN OUT SECONDS [options]`.

Each is a process of its own, one after the other, which is forked from this one: so PyTorch is loaded once for all of
them. After so many seconds none is begun any more; their order is drawn. Their results lie in OUT under the names of
their folders.
"""

from __future__ import annotations

import os
import random
import sys
import time
from pathlib import Path

from splatnode.capture.process.terminal import say
from splatnode.command_line import main as splatnode
from splatnode.recon import cli  # noqa: F401 (it is loaded before a process is forked)


def main() -> None:
    folder, out, seconds, options = Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]), sys.argv[4:]
    names, began_s = sorted(path.name for path in folder.iterdir()), time.monotonic()
    random.Random(0).shuffle(names)
    for number, name in enumerate(names, start=1):
        if time.monotonic() > began_s + seconds:
            break
        child = os.fork()
        if child == 0:
            os._exit(splatnode(["replay", str(folder / name), "--out", str(out / name), "--json", *options]))
        os.waitpid(child, 0)
        say(f"{number} of {len(names)} were replayed alone")


if __name__ == "__main__":
    main()
