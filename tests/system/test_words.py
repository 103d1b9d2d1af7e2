"""Names and first sentences of the product's code read as the field's: see "Words" in CONVENTIONS.md."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import ROOT
from tests.system.test_sizes import ROOMS

IRREGULAR = frozenset(
    (
        *("told", "shown", "begun", "made", "seen", "known", "found", "taken", "given", "gone", "kept", "held", "left"),
        *("put", "built", "drawn", "lit", "spread", "cut", "said", "heard", "thought", "met", "lost", "won", "worn"),
        *("laid", "bent", "understood"),
    )
)
PREPOSITIONS = frozenset(
    (
        *("without", "with", "of", "by", "in", "as", "at", "from", "on", "to", "beside", "beyond", "among"),
        *("through", "near"),
    )
)
VERBS_IN_ED = frozenset(("embed", "feed", "need", "speed", "seed", "shed", "bleed", "exceed", "proceed", "succeed"))
FRAGMENT = re.compile(r"(Of|That|By|With|What|Where|Whether it)\b")
# Names that the interface, a file format or a library gives; each says where it comes from
KNOWN_NAMES = frozenset(
    {
        "dropped",  # splatnode.Result, Capture
        "resized",  # splatnode.Intrinsics
        "at",  # splatnode.OccupancyMap
        "captured_at",  # fields of messages
        "given_pose",
        "on_open",  # a callback
    }
)


def find_words(source: str) -> Iterator[str]:
    """Yields what a reader of the field stumbles over: `line name`, or `line First words of a docstring`."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("__"):
            first = node.name.lstrip("_").split("_")[0]
            participle = (re.fullmatch("[a-z]+ed", first) and first not in VERBS_IN_ED) or first in IRREGULAR
            if (participle or first in PREPOSITIONS) and node.name not in KNOWN_NAMES:
                yield f"{node.lineno} {node.name}"
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            text = ast.get_docstring(node) or ""
            if FRAGMENT.match(text):
                yield f"{node.lineno} {text.splitlines()[0]}"


def list_sources(root: Path) -> Iterator[Path]:
    for room in ROOMS:
        for path in sorted((root / room).rglob("*.py")):
            if not any(parent.is_symlink() for parent in path.parents if parent != root):
                yield path


def test_functions_are_verbs_and_docstrings_are_sentences():
    found = [f"{path.relative_to(ROOT)}:{word}" for path in list_sources(ROOT) for word in find_words(path.read_text())]
    assert found == []


def test_what_is_no_verb_and_no_sentence_is_named():
    source = 'def climbed(): pass\ndef of_scene(): pass\ndef embed(): pass\nclass A:\n    """Of the errors."""\n'
    assert list(find_words(source)) == ["1 climbed", "2 of_scene", "4 Of the errors."]
