"""YAML that grows when it is read, and values that no configuration has."""

from __future__ import annotations

from collections.abc import Iterator

from tests.support.crafted.crafted import Crafted

NUMBERS = (
    ".nan",
    ".inf",
    "-.inf",
    "1e400",
    "-1e400",
    "1e308",
    "9" * 5000,
    "-9223372036854775809",
    "18446744073709551616",
)
NUMBERS_OF_AGES = ("1:" * 30_000 + "1", "0b" + "1" * 100_000, "0x" + "f" * 100_000, "1_" * 1000 + "1")


def configurations() -> Iterator[Crafted]:
    """Each is a whole file; none of them is a configuration of anything."""
    for key in ("kind", "folder", "names", "x"):
        yield Crafted(f"alias_bomb_{key}.yaml", _bomb(key), "aliases of aliases: 9^10 values when written out")
    for name, text in {
        "alias_of_itself": "camera: &a {kind: *a}",
        "merge_bomb": "a: &a {x: 1}\n" + "".join(f"k{n}: {{<<: [*a, *a]}}\n" for n in range(100)),
        "deep_list": "camera: " + "[" * 100_000,
        "deep_map": "camera: " + "{a: " * 100_000,
        "deep_blocks": "\n".join(" " * n + "a:" for n in range(700)),
        "deep_keys": "? " * 100_000,
        "many_values": "camera: [" + "x," * 120_000 + "]",
        "long_text": "camera: " + "x" * 200_000,
        "long_key": "x" * 200_000 + ": 1",
        "too_long": "# " + "x" * 10_000_000,
        "key_twice": "camera: {kind: synthetic}\ncamera: {kind: folder}",
        "key_number": "1: 2",
        "key_truth": "on: off",
        "key_nothing": "null: 2",
        "key_list": "[a, b]: 2",
        "key_map": "{a: b}: 2",
        "list": "[1, 2]",
        "scalar": "3",
        "two_documents": "a: 1\n---\nb: 2",
        "date": "camera: 2020-99-99",
        "binary": "camera: !!binary '####'",
        "set": "camera: !!set {a, b}",
        "pairs": "camera: !!omap [a: 1, a: 2]",
        "object": "camera: !!python/object/apply:os.system ['true']",
        "tag_of_a_list": "camera: !!map [a]",
        "tag_of_a_text": "camera: !!int abc",
        "tag_of_a_truth": "camera: !!bool 7",
        "null_byte": 'camera: {kind: folder, folder: "a\\0b"}',
        "half_letter": 'camera: {kind: folder, folder: "\\ud800"}',
        "escape": 'camera: {kind: "\\e[2J"}',
        "no_such_user": "camera: {kind: folder, folder: ~nobody-is-called-so/x}",
        "kind_is_a_list": "camera: {kind: [folder]}",
        "kind_is_a_map": "camera: {kind: {a: b}}",
        "kind_is_a_path": "camera: {kind: ../folder}",
        "kind_is_none": "camera: {kind: }",
    }.items():
        yield Crafted(f"{name}.yaml", text.encode(), name.replace("_", " "))
    for number, text in enumerate(NUMBERS + NUMBERS_OF_AGES):
        yield Crafted(f"number_{number}.yaml", f"camera: {{kind: synthetic, views: {text}}}".encode(), text[:20])
        yield Crafted(f"rate_{number}.yaml", f"camera: {{kind: synthetic, fps: {text}}}".encode(), text[:20])
    yield Crafted("zero_bytes.yaml", bytes(1000), "bytes that are no text")
    yield Crafted("latin.yaml", b"camera: \xff\xfe", "bytes that are no UTF-8")


def changes() -> Iterator[Crafted]:
    """Each is what stands after --set."""
    for name, text in {
        "deep_key": "a." * 100_000 + "a=1",
        "deep_value": "camera.kind=" + "[" * 100_000,
        "empty_names": "....=1",
        "no_value": "camera",
        "no_key": "=1",
        "alias": "camera.kind=*a",
        "map": "camera={kind: folder, kind: synthetic}",
        "long": "camera.kind=" + "x" * 100_000,
        "escape": "camera.\x1b[2J=1",
        **{f"number_{n}": f"camera.views={text}" for n, text in enumerate(NUMBERS + NUMBERS_OF_AGES)},
    }.items():
        yield Crafted(name, text.encode(), name.replace("_", " "))


def _bomb(key: str) -> bytes:
    rows = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    rows += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 10)]
    return "\n".join([*rows, "camera:", f"  {key}: *a9", ""]).encode()
