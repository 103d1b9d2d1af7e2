"""`./run`: what it installs for what is asked of it. A python that only notes how it was called stands for the real."""

from __future__ import annotations

import os
import subprocess

import pytest

from tests.conftest import ROOT


@pytest.fixture
def calls(tmp_path):
    """Runs ./run with arguments and gives the arguments of every call of python."""
    log, python = tmp_path / "calls", tmp_path / "venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\necho "$*" >>"{log}"\n')
    python.chmod(0o755)

    def call(*arguments: str) -> list[str]:
        log.unlink(missing_ok=True)
        environment = os.environ | {"SPLATNODE_VENV": str(tmp_path / "venv")}
        subprocess.run([ROOT / "run", *arguments], env=environment, check=True, capture_output=True)
        return log.read_text().splitlines()

    return call


@pytest.mark.parametrize(
    ("arguments", "extras"),
    [
        (["demo"], ""),
        (["test", "-x"], "[dev,bench]"),
        (["bench", "scene", "--out", "o"], "[bench]"),
        (["docs"], "[docs]"),
        (["view", "out"], "[viewer]"),
        (["view", "out", "--headless"], ""),
        (["view", "--web"], ""),
        (["view", "out", "--export=turntable.mp4"], ""),
        (["replay", "photos", "--out", "o", "--view"], "[viewer]"),
        (["replay", "view", "--out", "o", "--views", "3"], ""),
    ],
)
def test_what_is_installed_follows_from_what_is_asked_for(calls, arguments, extras):
    (installed,) = [line for line in calls(*arguments) if " -e " in line]
    assert installed.endswith(f" -e {ROOT}{extras}")


def test_the_site_is_built_or_shown_to_this_machine_alone(calls):
    assert calls("docs")[-1] == "-m mkdocs build --strict"
    assert calls("docs", "--serve")[-1] == "-m mkdocs serve --strict --dev-addr 127.0.0.1:8000"


def test_an_environment_that_is_set_up_is_left_alone(calls):
    assert any("pip install" in line for line in calls("demo"))
    again = calls("demo")
    assert not any("pip install" in line for line in again) and again[-1] == "-m splatnode demo"


def test_without_a_verb_it_says_what_there_is():
    said = subprocess.run([ROOT / "run"], capture_output=True, text=True)
    assert said.returncode == 2 and said.stdout.startswith("./run demo | test | check")
