"""Attacks guided by coverage: `python -m tests.fuzz.guided keyframes --seconds 60`, with the package atheris.

The fuzzer's bytes make the choices of what the adversary draws, and it keeps those that reach new lines of the
boundary. It ends at the first defect, with the case that shows it.
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
import tempfile
from importlib import import_module
from pathlib import Path


class Chosen(random.Random):
    """Chance that is read from bytes; zeros after their end."""

    def __init__(self, data: bytes) -> None:
        super().__init__(0)
        self._data, self._at = data, 0

    def getrandbits(self, count: int) -> int:
        size = (count + 7) // 8
        piece = self._data[self._at : self._at + size].ljust(size, b"\0")
        self._at += size
        return int.from_bytes(piece, "little") >> (8 * size - count)

    def random(self) -> float:
        return self.getrandbits(16) / 65536.0

    def randbytes(self, n: int) -> bytes:
        return self.getrandbits(8 * n).to_bytes(n, "little") if n else b""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("boundary")
    parser.add_argument("--seconds", type=int, default=60)
    args = parser.parse_args()
    atheris = import_module("atheris")  # which is on no list: few machines have it

    with atheris.instrument_imports(include=["splatnode"]):
        from tests.support.adversary.boundaries import BOUNDARIES, attempt
    found = [each for each in BOUNDARIES if each.name == args.boundary]
    if not found:
        parser.error(f"no boundary {args.boundary!r}; there are: {', '.join(each.name for each in BOUNDARIES)}")
    logging.disable(logging.CRITICAL)
    place = Path(tempfile.mkdtemp())

    def once(data: bytes) -> None:
        case = found[0].draw(Chosen(data))
        try:
            attempt(found[0], case, place / "case")
        except Exception:
            print(f"a defect of {args.boundary}: {case!r}"[:4000], flush=True)
            raise

    atheris.Setup([sys.argv[0], f"-max_total_time={args.seconds}", "-max_len=4096", "-verbosity=0"], once)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
