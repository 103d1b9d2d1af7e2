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
        (["robustness", "scene", "--out", "o"], "[bench]"),
        (["fuzz", "--seconds", "9"], "[dev,bench]"),
        (["docs"], "[docs]"),
        (["view", "out"], "[viewer]"),
        (["view", "out", "--headless"], ""),
        (["view", "--web"], ""),
        (["view", "out", "--viser"], "[viser]"),
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


def test_fuzzing_gets_its_options(calls):
    assert calls("fuzz", "--only", "writes")[-1] == "-m tests.fuzz --only writes"


@pytest.mark.parametrize(
    ("arguments", "given"),
    [
        ([], "-n 3 --dist loadfile --no-loadscope-reorder -m not long"),
        (["--all"], "-n 3 --dist loadfile --no-loadscope-reorder"),
        (["--all", "-m", "long", "-x"], "-n 3 --dist loadfile --no-loadscope-reorder -m long -x"),
        (["tests/recon/merging", "-x"], "tests/recon/merging -x"),
        (["-k", "merging"], "-k merging"),
    ],
)
def test_the_quick_tests_are_run_unless_others_are_named(calls, arguments, given):
    assert calls("test", *arguments)[-1] == f"-m pytest -q {given}"


def test_an_environment_that_is_set_up_is_left_alone(calls):
    assert any("pip install" in line for line in calls("demo"))
    again = calls("demo")
    assert not any("pip install" in line for line in again) and again[-1] == "-I -m splatnode demo"


def test_without_a_verb_it_says_what_there_is():
    said = subprocess.run([ROOT / "run"], capture_output=True, text=True)
    assert said.returncode == 2 and said.stdout.startswith("./run demo | test | check")


@pytest.fixture
def torch_from(tmp_path):
    """What ./run has pip install of PyTorch's own index, where pip is configured in this way and the index answers."""
    log, python = tmp_path / "calls", tmp_path / "venv" / "bin" / "python"
    python.parent.mkdir(parents=True)

    def call(config: str = "", answers: bool = True, choice: str | None = None, installs: bool = True):
        python.write_text(
            f"""#!/bin/sh
echo "$*" >>"{log}"
case "$*" in
    *"config list"*) printf '%s\\n' "{config}" ;;
    *urllib*) exit {int(not answers)} ;;
    *"--index-url"*) exit {int(not installs)} ;;
esac
"""
        )
        python.chmod(0o755)
        for stamp in python.parents[1].glob("*.stamp"):
            stamp.unlink()
        log.unlink(missing_ok=True)
        environment = os.environ | {"SPLATNODE_VENV": str(tmp_path / "venv")}
        environment.pop("SPLATNODE_TORCH", None)
        if choice is not None:
            environment["SPLATNODE_TORCH"] = choice
        done = subprocess.run([ROOT / "run", "demo"], env=environment, capture_output=True, text=True)
        asked = [line for line in log.read_text().splitlines() if "--index-url" in line] if log.exists() else []
        return done, asked

    return call


has_nvidia = subprocess.run(["sh", "-c", "grep -qs 0x10de /sys/bus/pci/devices/*/vendor"]).returncode == 0
own_choice = pytest.mark.skipif(has_nvidia, reason="has a GPU: the default index serves it")


@own_choice
def test_pytorch_comes_from_its_own_index_where_that_answers(torch_from):
    done, (asked,) = torch_from()
    assert done.returncode == 0 and " --no-deps --index-url https://" in asked and asked.endswith("/cpu torch")


def test_pytorch_comes_from_the_default_index_where_its_own_does_not_answer_or_is_not_wanted(torch_from):
    for case in ({"answers": False}, {"choice": "default"}):
        done, asked = torch_from(**case)
        assert done.returncode == 0 and not asked and done.stderr.count("\n") == 1, case


@pytest.mark.parametrize("option", ["global.index-url", "user.extra-index-url", ":env:.no-index", "site.index-url"])
def test_whoever_told_pip_of_an_index_gets_pytorch_from_there(torch_from, option):
    done, asked = torch_from(f"{option}='somewhere'")
    assert done.returncode == 0 and not asked


@own_choice
def test_other_settings_of_pip_name_no_index(torch_from):
    assert torch_from("global.cert='index-url'\nglobal.timeout='9'")[1]


@own_choice
def test_an_index_that_lacks_the_version_costs_nothing_unless_it_was_asked_for(torch_from):
    done, asked = torch_from(installs=False)
    assert asked and done.returncode == 0
    done, asked = torch_from(installs=False, choice="cpu")
    assert asked and done.returncode == 69 and "PyTorch could not be installed from" in done.stderr


def test_a_choice_that_is_none_is_told(torch_from):
    done, asked = torch_from(choice="gpu")
    assert done.returncode == 69 and not asked and "SPLATNODE_TORCH must be cpu or default, is gpu" in done.stderr


@pytest.mark.parametrize("arguments", [["demo"], ["replay", "a", "--view"], ["bench"], ["wheels"], ["release"]])
def test_no_python_runs_what_lies_in_the_current_folder(calls, arguments):
    """A folder of photographs may hold pip.py. `test`, `check` and `docs` are run in the checkout."""
    told = [line for line in calls(*arguments) if line.startswith("-")]  # the others go on with what -c is told
    assert len(told) > 2 and all(line.startswith("-I ") for line in told)
