"""Every verb, flag and configuration key that a page names is one that there is, by its present name."""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterator

import pytest
import yaml

from splatnode import command_line
from splatnode.capture.process import former_names
from tests.conftest import ROOT
from tests.system.test_pages import PAGES, text

LOOKED_AT = sorted(set(PAGES) - {"CHANGELOG.md", "docs/configuration.md"})  # what was renamed; what is made of the code
RUN_VERBS = {"test", "check", "docs", "wheels", "release", "fuzz"}  # of ./run alone
FLAGS_OF_OTHERS = {"--no-compile", "--find-links", "--all", "--serve", "--only", "--room", "--seed", "--pictures"}
KEYS = set(re.findall(r"^\| `([\w.]+)` \| ", text("docs/configuration.md"), re.MULTILINE))
FORMER_SECTIONS = {former for former in former_names.RECONSTRUCTION_KEYS | former_names.NODE_KEYS if "." not in former}
SECTIONS = {key.partition(".")[0] for key in KEYS if "." in key} | FORMER_SECTIONS
OF_A_RIG = {"T_rig_camera", "sigma_m", "sigma_deg", "metric"}  # of a camera in rig.yaml (capture/rig.py)
SUFFIXES = {"npz", "bt", "json", "pgm", "png", "yaml", "py"}  # occupancy.npz is no key of `occupancy`


def verbs() -> dict[str, set[str]]:
    """The flags of each verb."""
    (subparsers,) = (
        action for action in command_line.build_parser()._actions if isinstance(action, argparse._SubParsersAction)
    )
    return {
        name: {flag for action in parser._actions for flag in action.option_strings}
        for name, parser in subparsers.choices.items()
    }


VERBS = verbs()


def commands(page: str) -> Iterator[tuple[str, str]]:
    """The verb and the rest of each command line of splatnode that the page has, in a block or within a sentence."""
    whole = text(page)
    blocks = re.findall(r"^ *```(?:sh|bash)\n(.*?)^ *```$", whole, re.DOTALL | re.MULTILINE)
    spans = re.findall(r"`([^`]+)`", re.sub(r"^ *```.*?^ *```$", "", whole, flags=re.DOTALL | re.MULTILINE))
    for line in [*"\n".join(blocks).splitlines(), *(re.sub(r"\s+", " ", span) for span in spans)]:
        code = re.sub(r"\s#.*", "", line)
        for command in re.split(r"[;|]|&&|\$\(", code):
            found = re.search(r"(?:^|\s)(?:splatnode|\./run) ([a-z][\w-]*)(.*)", command)
            if found and (found[1] not in RUN_VERBS or "./run" not in command):
                yield found[1], found[2]


@pytest.mark.parametrize("page", LOOKED_AT)
def test_commands_have_verbs_and_flags_that_there_are(page):
    wrong = []
    for verb, rest in commands(page):
        if verb not in VERBS:
            wrong.append(verb)
            continue
        flags = set(re.findall(r"(?<!\S)--[a-z][\w-]*", rest))
        wrong += [f"{verb} {flag}" for flag in flags - VERBS[verb]]
    assert not wrong, f"{page} has commands that splatnode does not know"


@pytest.mark.parametrize("page", LOOKED_AT)
def test_flags_by_themselves_are_of_some_verb(page):
    known = set().union(*VERBS.values()) | FLAGS_OF_OTHERS
    named = set(re.findall(r"`(--[a-z][\w-]*)", text(page)))
    assert named <= known, f"{page} names flags that no verb has"


def is_key(key: str) -> bool:
    return key in KEYS or any(known.startswith(f"{key}.") for known in KEYS)


@pytest.mark.parametrize("page", LOOKED_AT)
def test_keys_are_of_the_configuration(page):
    named = re.findall(r"`(?:reconstruction\.)?([a-z_]+(?:\.[a-z_]+)+)", text(page))
    keys = {key for key in named if key.partition(".")[0] in SECTIONS and key.rpartition(".")[2] not in SUFFIXES}
    unknown = {key for key in keys if not is_key(key)}
    assert not unknown, f"{page} names keys that docs/configuration.md does not have"


def list_keys(block: object, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The keys of a YAML block, each with the keys that it is below."""
    if isinstance(block, dict):
        for name, value in block.items():
            yield (*path, str(name))
            yield from list_keys(value, (*path, str(name)))


def is_configured(path: tuple[str, ...]) -> bool:
    """Whether an option of capture, of recon or of a lens stands at the path."""
    if path[0] == "reconstruction":
        path = path[1:]
    if path[:1] == ("cameras",) and path[2:] and path[2] in OF_A_RIG:
        return True
    if path[:1] == ("cameras",):  # several cameras, or several lenses
        path = ("camera", *path[2:])
    if path[-1:] == ("kind",) or path in {(), ("camera", "count")}:  # count: of the camera that a page invents
        return True
    below = ".".join(path[1:])
    return is_key(".".join(path)) or is_key(f"camera.intrinsics.{below}") or is_key(below)


@pytest.mark.parametrize("page", LOOKED_AT)
def test_configurations_on_a_page_have_keys_that_there_are(page):
    blocks = re.findall(r"^```yaml\n(.*?)^```$", text(page), re.DOTALL | re.MULTILINE)
    whole = re.sub(r"\s+", " ", text(page))  # a span may be broken into lines
    spans = [span for span in re.findall(r"`([a-z_]+: \{[^`]+\})`", whole) if "..." not in span]
    paths = [path for block in [*blocks, *spans] for path in list_keys(yaml.safe_load(block))]
    unknown = [".".join(path) for path in paths if not is_configured(path)]
    assert not unknown, f"{page} configures what there is not"


def list_former_words() -> set[str]:
    """Flags and dotted keys of the release before, as a sentence may name them."""
    flags = {flag for flags in former_names.FLAGS.values() for flag in flags}
    tables = former_names.CAPTURE_KEYS | former_names.RECONSTRUCTION_KEYS | former_names.NODE_KEYS
    sections = {former: present for former, present in tables.items() if "." not in former}
    keys = {re.sub(r"\[.*?\]", "", former) for former in tables if "." in former}
    moved = {
        f"{former}.{key.partition('.')[2]}"
        for former, present in sections.items()
        for key in KEYS
        if key.startswith(f"{present}.")
    }
    return (flags | keys | moved) - KEYS


def test_no_sentence_of_the_program_has_a_former_name():
    former = re.compile(
        rf"(?<![\w.-])(?:{'|'.join(map(re.escape, sorted(list_former_words(), reverse=True)))})(?![\w.-])"
    )
    found = []
    for room in ("splatnode/api", "capture", "recon", "viewer", "extras"):
        for path in (ROOT / room).rglob("*.py"):
            if path.name == "former_names.py":
                continue
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if (
                    isinstance(node, ast.Constant)
                    and isinstance(node.value, str)
                    and (word := former.search(node.value))
                ):
                    found.append(f"{path.relative_to(ROOT)}:{node.lineno} {word[0]}")
    assert not found
