"""What a mutant is, and the tests that come first for it."""

from __future__ import annotations

import ast
import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

_CORE_FUNCTION = re.compile(r"^CORE_API [\w* ]*?(\w+)\(", re.MULTILINE)

_OF_MUTANTS = "tests/mutants/"  # each mutant breaks these, for it applies no more


@dataclass(frozen=True)
class Mutant:
    """A small plausible fault: a text that occurs once in a file, and what stands there instead."""

    room: str
    name: str  # what is wrong then
    file: str  # from the checkout on
    find: str
    replace: str

    @property
    def digest(self) -> str:
        """Changes when the mutant does: a record of another one is no record of it."""
        return hashlib.sha256("\0".join((self.file, self.find, self.replace)).encode()).hexdigest()[:12]

    @property
    def is_native(self) -> bool:
        """Whether the core has to be compiled anew for it."""
        return self.file.endswith((".cpp", ".h"))


def apply_mutant(mutant: Mutant, text: str) -> str:
    """The text of the mutant's file with the fault. Raises ValueError unless what it replaces occurs exactly once."""
    count = text.count(mutant.find)
    if count != 1:
        raise ValueError(
            f"{mutant.file} must hold {mutant.find!r} once for the mutant {mutant.name!r}, holds it {count} times: "
            "change the mutant in tests/mutants/table.py to what the code says now"
        )
    return text.replace(mutant.find, mutant.replace)


def order_tests(root: Path, file: str) -> tuple[list[str], list[str]]:
    """The files of tests that are near to a file of the product, the nearest first; and all others.

    Near are those that import or name its module, or import what imports it for tests (tests/support); and those in the
    folder that mirrors its own. A file of the core is near to what the modules are near to that call it.
    """
    every = [path.relative_to(root).as_posix() for path in sorted((root / "tests").rglob("test_*.py"))]
    every = [name for name in every if not name.startswith(_OF_MUTANTS)]
    near = dict.fromkeys(name for each in _list_callers(root, file) for name in _list_near(root, each, every))
    return list(near), [name for name in every if name not in near]


def _list_near(root: Path, file: str, every: Sequence[str]) -> list[str]:
    module = f"splatnode.{file.removesuffix('.py').replace('/', '.')}"
    own, ranks = Path("tests", Path(file).parent, f"test_{Path(file).stem}.py"), dict[str, int]()
    for name in every:
        text, imported = (root / name).read_text(encoding="utf-8"), _list_imports(root / name)
        direct = module in imported or module in text or file in text
        through = any(module in _list_support_imports(root, each) for each in imported)
        beside = Path(name).parent == own.parent
        if direct or through or beside:
            ranks[name] = 0 if Path(name) == own else 1 if direct and beside else 2 if direct else 3 if beside else 4
    return sorted(ranks, key=lambda name: (ranks[name], name))


def _list_callers(root: Path, file: str) -> list[str]:
    """The file itself, or the modules of the product that call the functions which a file of the core has."""
    if file.endswith(".py"):
        return [file]
    functions = _CORE_FUNCTION.findall((root / file).read_text(encoding="utf-8"))
    sources = (path for path in sorted((root / "recon").rglob("*.py")) if "core" not in path.parts)
    texts = ((path, path.read_text(encoding="utf-8")) for path in sources)
    return [path.relative_to(root).as_posix() for path, text in texts if any(f".{each}(" in text for each in functions)]


def _list_support_imports(root: Path, module: str) -> frozenset[str]:
    """The modules that a module of tests/ imports; none for any other module."""
    path = root / f"{module.replace('.', '/')}.py"
    return _list_imports(path) if module.startswith("tests.") and path.is_file() else frozenset()


@cache
def _list_imports(path: Path) -> frozenset[str]:
    """The modules that a file imports, and what may be a module among the names that it imports from them."""
    return frozenset(_walk_imports(ast.parse(path.read_text(encoding="utf-8"))))


def _walk_imports(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (each.name for each in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
            yield from (f"{node.module}.{each.name}" for each in node.names)
