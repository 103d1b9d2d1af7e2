"""How processes are started and what is unpickled, in all files of the rooms: nothing is done in a way of its own."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.conftest import ROOT

ROOMS = ("capture", "recon", "viewer", "extras", "splatnode/api")
FILES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))
FILES += sorted((ROOT / "splatnode").glob("*.py"))
STARTS = {
    "capture/process/python.py",  # the one way
    "capture/process/start.py",  # what is run there first
    "extras/jobs/launch.py",  # becomes the command that it was given
    "recon/core/release.py",  # the Python of a clean environment, isolated
}
UNPICKLES = {
    "extras/jobs/__init__.py",  # from a folder of this user alone, or from Ray
    "extras/jobs/template.py",  # from a folder of this user alone
    "extras/evaluate/runner.py",  # from a temporary folder of this user alone
    "extras/evaluate/stability/window_campaign.py",  # arguments of a call
    "extras/evaluate/stability/windows.py",  # arguments of a call
    "recon/networks/lpips.py",  # arrays and nothing else
}
_STARTERS = {"system", "popen", "fork_exec", "posix_spawn", "posix_spawnp"}
_POOLS = {"multiprocessing", "ProcessPoolExecutor", "runpy", "pty"}
_PICKLES = {"dill", "cloudpickle", "joblib", "shelve", "marshal", "jsonpickle"}


@cache
def trees() -> dict[str, ast.AST]:
    return {str(path.relative_to(ROOT)): ast.parse(path.read_bytes()) for path in FILES}


def name_of(node: ast.AST) -> str:
    """Such as sys.executable; "" for what is no name."""
    if isinstance(node, ast.Attribute):
        return f"{name_of(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def names_in(tree: ast.AST) -> Iterator[str]:
    """Of all that is imported and used, dotted."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Attribute):
            yield name_of(node)


def starts(tree: ast.AST) -> Iterator[str]:
    """Ways to start Python or what a shell finds."""
    for name in names_in(tree):
        parts = name.split(".")
        of_system = parts[0] == "os" and (parts[-1] in _STARTERS or parts[-1].startswith(("exec", "spawn")))
        if name in ("sys.executable", "sys._base_executable") or set(parts) & _POOLS or of_system:
            yield name
    for node in ast.walk(tree):
        if isinstance(node, (ast.List, ast.Tuple, ast.BinOp)):  # a command, or a path
            told = [node.right] if isinstance(node, ast.BinOp) else node.elts
            texts = (each.value for each in told if isinstance(each, ast.Constant) and isinstance(each.value, str))
            yield from filter(_is_python, texts)
        if isinstance(node, ast.keyword) and node.arg == "shell":
            yield "shell="


def _is_python(text: str) -> bool:
    return Path(text.partition(" ")[0]).name.rstrip("0123456789.") == "python" and "\n" not in text


def unpickles(tree: ast.AST) -> Iterator[str]:
    """Ways to run what a file says."""
    for name in names_in(tree):
        if name in ("pickle.load", "pickle.loads", "pickle.Unpickler") or name.split(".")[0] in _PICKLES:
            yield name
    for node in (each for each in ast.walk(tree) if isinstance(each, ast.Call)):
        told = {each.arg: getattr(each.value, "value", None) for each in node.keywords}
        if name_of(node.func) == "torch.load" and told.get("weights_only") is not True:
            yield "torch.load without weights_only=True"
        if name_of(node.func) in ("np.load", "numpy.load") and told.get("allow_pickle") is not False:
            yield "np.load without allow_pickle=False"


@pytest.mark.parametrize(("find", "allowed"), [(starts, STARTS), (unpickles, UNPICKLES)], ids=["starts", "unpickles"])
def test_it_is_done_in_the_files_that_are_known(find, allowed):
    found = {file: sorted(set(find(tree))) for file, tree in trees().items()}
    found = {file: ways for file, ways in found.items() if ways}
    assert not {file: ways for file, ways in found.items() if file not in allowed}
    assert allowed <= set(found), "a file that is allowed does it no more: take it off the list"


@pytest.mark.parametrize(
    "code",
    [
        "import sys; run(sys.executable)",
        "from sys import executable",
        "import multiprocessing",
        "from torch import multiprocessing as m",
        "from concurrent.futures import ProcessPoolExecutor",
        "subprocess.run(['python3', 'x'])",
        "subprocess.run(x, shell=True)",
        "os.execv(a, b)",
        "os.system('ls')",
    ],
)
def test_a_way_is_found(code):
    assert list(starts(ast.parse(code)))


@pytest.mark.parametrize("code", ["from pickle import loads", "pickle.load(f)", "torch.load(f)", "np.load(f)"])
def test_a_pickle_is_found(code):
    assert list(unpickles(ast.parse(code)))
