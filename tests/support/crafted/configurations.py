"""YAML that grows when it is read, and values that no configuration has."""

from __future__ import annotations

from collections.abc import Iterator

from tests.support.crafted.crafted import Crafted


def configurations() -> Iterator[Crafted]:
    for key in ("kind", "camera", "x"):
        rows = [b"a0: &a0 [x, x, x, x, x, x, x, x, x]"]
        rows += [b"a%d: &a%d [%s]" % (n, n, b", ".join([b"*a%d" % (n - 1)] * 9)) for n in range(1, 10)]
        bomb = b"\n".join(rows) + b"\ncamera:\n  %s: *a9\n" % key.encode()
        yield Crafted(f"alias_bomb_{key}.yaml", bomb, "aliases of aliases: 9^10 values when written out")


def changes() -> Iterator[Crafted]:
    """Each is what stands after --set."""
    yield Crafted("deep", b"camera.kind=" + b"[" * 100_000, "nested deeper than a parser may recurse")
