"""The ways through the code that docs/architecture.md shows: files that there are, each called by one before it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from tests.conftest import ROOT

MOST_FILES, MOST_CLIMBS = 12, 3
ROW = re.compile(r"^\| ([^|]+) \| `(\w+)` \| ((?:`[^`]+`(?:, )?)+) \|$", re.MULTILINE)
WAYS = {
    what: (function, re.findall(r"`([^`]+)`", files))
    for what, function, files in ROW.findall((ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"))
}


def imported_by(path: str) -> set[str]:
    """The modules that a file imports, and the packages in which these lie."""
    tree = ast.parse(Path(ROOT, path).read_text(encoding="utf-8"))
    found = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    found |= {
        f"{node.module}.{each.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for each in node.names
    }
    return {each.removeprefix("splatnode.").replace(".", "/") for each in found}


def is_known(path: str, before: list[str]) -> bool:
    """Whether one of the files `before` imports this one, or the package that finds it by its name."""
    known = set().union(*map(imported_by, before))
    folder = path.rpartition("/")[0]
    own = folder if path.endswith("/__init__.py") else path.removesuffix(".py")
    return own in known or (folder == "recon/priors" and folder in known)


def test_there_are_three_ways():
    assert len(WAYS) == 3


@pytest.mark.parametrize("what", WAYS)
def test_each_file_of_a_way_is_called_by_one_before_it(what):
    function, files = WAYS[what]
    paths = [each.removeprefix("↑ ") for each in files]
    assert all(Path(ROOT, path).is_file() for path in paths) and len(set(paths)) == len(paths) <= MOST_FILES
    assert re.search(rf"^ *def {function}\(", Path(ROOT, paths[0]).read_text(encoding="utf-8"), re.MULTILINE)
    unknown = [files[place] for place in range(1, len(files)) if not is_known(paths[place], paths[:place])]
    assert unknown == [each for each in files if each.startswith("↑")] and len(unknown) <= MOST_CLIMBS
