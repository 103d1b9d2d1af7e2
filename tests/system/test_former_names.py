"""Every name of the release before still works, is told once, and is in no help and on no page."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator

import msgspec
import pytest

from splatnode import command_line
from splatnode.capture.config import Camera, CaptureConfig
from splatnode.capture.process import config as config_keys
from splatnode.capture.process import former_names
from splatnode.capture.process.arguments import replace_former_words
from splatnode.capture.process.config import build_config, list_field_types, parse_config
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon.config import DaemonConfig

REQUIRED = {"folder": "f", "file": "f", "part": "0"}  # by kinds of cameras
TABLES = [
    *((CaptureConfig, former, present) for former, present in former_names.CAPTURE_KEYS.items()),
    *((ReconstructionConfig, former, present) for former, present in former_names.RECONSTRUCTION_KEYS.items()),
    *((DaemonConfig, former, present) for former, present in former_names.NODE_KEYS.items()),
]


def documents(schema: type, path: str, name: str) -> Iterator[tuple[dict, dict]]:
    """A file with the key by its former name and one by `name`, with its default, for each kind that has it."""
    *sections, former = re.sub(r"\[.*\]", "", path).split(".")
    kinds = re.findall(r"\[(.*)\]", path) or (Camera.kinds() if sections[:1] == ["camera"] else [""])
    for kind in kinds:
        base = {"camera": camera(kind or "synthetic")} if schema is CaptureConfig else {}
        value = msgspec.to_builtins(build_config(base, schema), enc_hook=str)
        for section in sections:
            value = value[section]["config"] if section == "camera" else value[section]
        if name in value:
            yield laid(base, sections, {former: value[name]}), laid(base, sections, {name: value[name]})


def camera(kind: str) -> dict[str, str]:
    fields = msgspec.structs.fields(Camera(kind, None).module.Config)
    return {"kind": kind} | {field.name: REQUIRED[field.name] for field in fields if field.required}


def laid(base: dict, sections: list[str], leaf: dict) -> dict:
    for section in reversed(sections):
        leaf = {section: base.get(section, {}) | leaf}
    return base | leaf


@pytest.mark.parametrize(("schema", "former", "present"), TABLES, ids=lambda each: getattr(each, "__name__", each))
def test_a_former_key_means_what_the_present_one_does(schema, former, present, caplog):
    pairs = list(documents(schema, former, present))
    assert pairs, f"no {present} beside {former}"
    for written, expected in pairs:
        config_keys._warn_once.cache_clear()
        caplog.clear()
        assert parse_config(written, schema) == build_config(expected, schema)
        assert any("the former name is read in this release only" in record.message for record in caplog.records)


def test_former_keys_are_none_of_today():
    for schema, former, _ in TABLES:
        if "." not in former:
            assert former not in list_field_types(schema)


def test_former_keys_of_a_reconstruction_are_read_in_a_node_s_file(caplog):
    config_keys._warn_once.cache_clear()
    config = parse_config({"reconstruction": {"quick": True, "ladder": {"work": 1}}, "settle_s": 9}, DaemonConfig)
    assert config.reconstruction.no_fallbacks and config.reconstruction.fallbacks.budget == 1
    assert config.idle_finalize_s == 9
    assert "reconstruction.quick is called no_fallbacks now" in caplog.text


def subparsers() -> dict[str, argparse.ArgumentParser]:
    (action,) = (each for each in command_line.build_parser()._actions if isinstance(each, argparse._SubParsersAction))
    return dict(action.choices)


def test_former_verbs_and_flags_are_in_no_help():
    parsers = subparsers()
    assert not {*former_names.VERBS} & {*parsers}
    for verb, flags in former_names.FLAGS.items():
        known = parsers[verb]._option_string_actions
        assert {*flags.values()} <= {*known} and not {*flags} & {*known}, verb
    assert {*former_names.VERBS.values()} <= {*parsers}


@pytest.mark.parametrize(
    ("given", "expected", "told"),
    [
        ("", "", 0),
        ("find --json", "list-cameras --json", 1),
        ("replay a --out b --require 2 --quick", "replay a --out b --max-position-error 2 --no-fallbacks", 2),
        ("replay a --require=2", "replay a --max-position-error=2", 1),
        ("stability --told exif", "robustness --known-lens exif", 2),
        ("replay --quick -- --quick", "replay --no-fallbacks -- --quick", 1),
        ("export a --to ply --quick", "export a --to ply --quick", 0),
    ],
)
def test_a_command_line_is_taken_by_its_present_names(given, expected, told):
    words, sentences = replace_former_words(given.split(), former_names.VERBS, former_names.FLAGS)
    assert (words, len(sentences)) == (expected.split(), told)


def test_a_former_verb_runs_and_is_told_on_standard_error(capsys, monkeypatch):
    monkeypatch.setattr("splatnode.capture.cli.find", lambda args: 0)
    assert command_line.main(["find"]) == 0
    said = capsys.readouterr()
    assert said.out == "" and said.err.strip() == (
        "splatnode: find is called list-cameras now; the former name is read in this release only"
    )
