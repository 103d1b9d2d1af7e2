"""JSON and YAML: good trees with something done to them, and texts that no tree has."""

from __future__ import annotations

import json
import random
from typing import Any

import yaml

from tests.support.adversary import edges


def json_file(rng: random.Random, tree: Any) -> bytes:
    """`tree` mangled as a JSON file; NaN and Infinity as Python writes them, and numbers that no float holds."""
    text = json.dumps(edges.mangled(rng, tree, rng.choice((0, 1, 1, 2))), default=lambda value: value.hex())
    action = rng.random()
    if action < 0.03:
        text = rng.choice(("[" * 2000, '{"cameras":' * 2000, "[" * 100_000 + "]" * 100_000)) + text
    elif action < 0.1:
        text = text.replace("1.0", rng.choice(("1e400", "-1e400", "9" * 5000, "1e-400", "0x10", "1_0")), 1)
    elif action < 0.13:
        return edges.damaged(rng, text.encode(), 1)
    elif action < 0.15:
        text = text.replace('"name"', '"width"', 1)
    return text.encode("utf-8", "surrogatepass")


def yaml_file(rng: random.Random, tree: Any) -> bytes:
    """`tree` mangled as a YAML file; anchors, tags, nesting and numbers of YAML 1.1 among its values."""
    text = yaml.safe_dump(edges.mangled(rng, tree, rng.choice((0, 1, 1, 2))), allow_unicode=True)
    action = rng.random()
    if action < 0.12:
        text += rng.choice(_ODD_YAML) + "\n"
    elif action < 0.15:
        text = text.replace(
            ": ", rng.choice((": &a ", ": *a ", ": !!python/object:os.system ", ": !!binary ", ": |\n ")), 1
        )
    elif action < 0.18:
        return edges.damaged(rng, text.encode("utf-8", "surrogatepass"), 1)
    return text.encode("utf-8", "surrogatepass")


def _bomb() -> str:
    lines = ["bomb: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"b{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 9)]
    return "\n".join([*lines, "kind: *a8"])


_ODD_YAML = (
    _bomb(),
    "[" * 3000,
    "? [a, b]\n: c",
    "a: {<<: [&x {b: 1}, *x]}",
    "network: {first_port: 0o777777777777777777777777}",
    "reader: {frame_timeout_s: .inf}",
    "reader: {frame_timeout_s: .nan}",
    "selection: 190:20:30",
    "spool: {max_mb: 1" + "0" * 5000 + "}",
    "2026-11-23: 1",
    "~: 1",
    "1: 2",
    "camera: !!set {a, b}",
    "--- a\n--- b",
    "%YAML 9.9",
    "\t- x",
    "a: &a [*a]",
)
