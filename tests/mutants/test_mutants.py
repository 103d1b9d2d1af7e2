"""The table of mutants does not rot, and what becomes of a mutant in a small checkout is told rightly."""

from __future__ import annotations

import json
import subprocess
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.mutants.__main__ import RECORD, Trial, main, read_fates, summarize, write_fates
from tests.mutants.copy import Copy, make_copy
from tests.mutants.mutant import Mutant, apply_mutant, order_tests
from tests.mutants.table import MUTANTS

HONEST = ("recipes", "scoring", "fit")  # the rooms on which published figures rest


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_each_mutant_still_applies(mutant):
    """Where it does not, change its lines in tests/mutants/table.py to what the code says now."""
    before = (ROOT / mutant.file).read_text(encoding="utf-8")
    after = apply_mutant(mutant, before)
    assert after != before
    if not mutant.is_native:
        compile(after, mutant.file, "exec")


def test_no_mutant_is_there_twice():
    for values in ([each.name for each in MUTANTS], [each.digest for each in MUTANTS]):
        assert Counter(values).most_common(1)[0][1] == 1


def test_the_tests_found_nine_of_ten_and_all_of_the_honest_parts():
    fates = read_fates(RECORD)
    assert sum(fate.killed for fate in fates.values()) >= 0.9 * len(fates)
    assert [fate.name for fate in fates.values() if fate.room in HONEST and not fate.killed] == []


def test_the_killers_that_are_on_record_are_there():
    for fate in read_fates(RECORD).values():
        if fate.test is not None:
            file, _, rest = fate.test.partition("::")
            name = rest.partition("[")[0].rpartition("::")[2]
            assert f"def {name}(" in (ROOT / file).read_text(encoding="utf-8"), f"try again: --only {fate.name!r}"


def test_a_text_that_is_not_there_once_is_told_with_what_to_do():
    mutant = Mutant("room", "all is lost", "recon/a.py", "x = 1", "x = 2")
    assert apply_mutant(mutant, "x = 1\n") == "x = 2\n"
    for text, count in (("y = 1\n", 0), ("x = 1\nx = 1\n", 2)):
        with pytest.raises(
            ValueError, match=f"recon/a.py must hold 'x = 1' once .*'all is lost', holds it {count} times"
        ):
            apply_mutant(mutant, text)


def test_the_nearest_tests_come_first_and_those_of_mutants_never(tmp_path):
    files = {
        "recon/scene/growth.py": "", "recon/scene/fold.py": "library().core_fold(a)\n",
        "recon/core/fold.cpp": "CORE_API void core_fold(int a) {}\n",
        "tests/support/grown.py": "from splatnode.recon.scene import growth\n",
        "tests/mutants/test_mutants.py": "from splatnode.recon.scene import growth\n",
        "tests/recon/scene/test_growth.py": "", "tests/recon/scene/test_beside.py": "",
        "tests/recon/scene/test_zones.py": "from splatnode.recon.scene.growth import grow\n",
        "tests/api/test_call.py": "import splatnode.recon.scene.growth\n",
        "tests/viewer/test_through.py": "from tests.support.grown import plant\n",
        "tests/viewer/test_far.py": "from splatnode.recon.scene import fold\n",
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    near, others = order_tests(tmp_path, "recon/scene/growth.py")
    names = [Path(name).stem for name in near]
    assert names == ["test_growth", "test_zones", "test_call", "test_beside", "test_through"]
    assert others == ["tests/viewer/test_far.py"]
    of_core, _ = order_tests(tmp_path, "recon/core/fold.cpp")  # near to what calls it
    assert of_core[0] == "tests/viewer/test_far.py"


# A checkout with one function and two tests


SUM = "def add(a, b):\n    return a + b\n\n\ndef wait():\n    return 0.0\n"
TESTS = {
    "tests/recon/test_addition.py": "import time\nfrom recon.addition import add, wait\n\n\n"
    "def test_nothing(): time.sleep(wait())\n\n\ndef test_sum(): assert add(2, 3) == 5\n",
    "tests/recon/test_before.py": "# recon/addition.py\ndef test_fails_anyway(): assert False\n",
    "tests/test_far.py": "import importlib\n\n\n"
    "def test_zero(): assert importlib.import_module('recon.addition').add(0, 1)\n",
}


def mutant(find: str, to: str) -> Mutant:
    return Mutant("room", f"{to} instead", "recon/addition.py", find, to)


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Iterator[tuple[Path, Copy]]:
    root = tmp_path_factory.mktemp("small") / "checkout"
    nursery = (ROOT / "tests" / "mutants" / "nursery.py").read_text(encoding="utf-8")
    lean = "\n".join("PACKAGES = ('pytest',)" if line.startswith("PACKAGES") else line for line in nursery.splitlines())
    files = {"recon/addition.py": "def add(a, b): ...\n", "tests/mutants/nursery.py": lean, **TESTS}
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")
    told = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init", "-q"], ["add", "-A"], [*told, "commit", "-q", "-m", "small"]):
        subprocess.run(["git", *command], cwd=root, check=True)
    (root / "recon/addition.py").write_text(SUM)  # what is not committed counts, too
    with pytest.MonkeyPatch.context() as changed:
        changed.setenv(
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1"
        )  # importing what others installed takes longer than the tests
        with make_copy(root) as copy:
            yield root, copy


def test_a_test_that_fails_without_the_mutant_too_kills_none(small):
    root, copy = small
    trial = Trial(copy, 60.0, False, {})
    killed = trial.try_mutant(mutant("a + b", "a - b"))
    assert killed.killed and killed.test == "tests/recon/test_addition.py::test_sum"
    survivor = trial.try_mutant(mutant("a + b", "b + a"))
    assert not survivor.killed and survivor.test is None and not survivor.whole
    assert (root / "recon/addition.py").read_text() == (copy.folder / "recon/addition.py").read_text() == SUM


def test_far_tests_run_where_they_are_asked_for(small):
    _, copy = small
    far = mutant("a + b", "a + b if b != 1 else 0")
    assert not Trial(copy, 60.0, False, {}).try_mutant(far).killed
    whole = Trial(copy, 60.0, True, {}).try_mutant(far)
    assert whole.killed and whole.test == "tests/test_far.py::test_zero"


def test_what_killed_it_last_time_comes_first(small, monkeypatch):
    _, copy = small
    asked = []
    ran = copy.run_tests
    monkeypatch.setattr(copy, "run_tests", lambda tests, *rest: asked.append([*tests]) or ran(tests, *rest))
    same = mutant("a + b", "a * b")
    killer = "tests/recon/test_addition.py::test_sum"
    assert Trial(copy, 60.0, False, {same.name: killer}).try_mutant(same).test == killer
    assert asked == [[killer], [killer]]  # with the mutant, and without


def test_a_mutant_that_makes_tests_hang_survives_in_time(small):
    _, copy = small
    fate = Trial(copy, 2.0, False, {}).try_mutant(mutant("return 0.0", "return 60.0"))
    assert not fate.killed and fate.seconds < 20.0


def test_a_mutant_that_ends_the_process_is_killed_by_the_test_that_ran(small):
    _, copy = small
    fate = Trial(copy, 60.0, False, {}).try_mutant(mutant("return 0.0", "return __import__('os').abort()"))
    assert fate.killed and fate.test == "tests/recon/test_addition.py::test_nothing"


def test_a_campaign_goes_on_where_it_ended(tmp_path, monkeypatch, capsys):
    out, tried = tmp_path / "mutants.json", []
    chosen = MUTANTS[:12]

    class Pretended:
        def __init__(self, *rest) -> None:
            pass

        def try_mutant(self, mutant: Mutant):
            tried.append(mutant.name)
            if len(tried) == 5:
                raise KeyboardInterrupt
            return Trial._make_fate(self, mutant, None if mutant == chosen[0] else "tests/test_a.py::test_b", 1.0)

        _whole = False

    monkeypatch.setattr("tests.mutants.__main__.MUTANTS", chosen)
    monkeypatch.setattr("tests.mutants.__main__.Trial", Pretended)
    monkeypatch.setattr("tests.mutants.__main__.make_copy", lambda root: _NoCopy())
    with pytest.raises(KeyboardInterrupt):
        main(["--out", str(out)])
    assert len(read_fates(out)) == 4
    assert main(["--out", str(out), "--resume"]) == 0 and len(tried) == 13  # the fifth twice
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.split() == ["all", "11", "of", "12", "killed"]
    assert main(["--out", str(out), "--resume", "--only", chosen[0].name]) == 1  # none of one was found
    assert main(["--only", "no such"]) == 2 and chosen[3].name in capsys.readouterr().err


class _NoCopy:
    commit = "0000000"

    def __enter__(self):
        return self

    def __exit__(self, *error):
        return None


def test_a_changed_mutant_is_not_the_one_on_record(tmp_path, small):
    _, copy = small
    fate = Trial(copy, 60.0, False, {})._make_fate(MUTANTS[0], "tests/test_a.py::test_b", 1.0)
    write_fates(tmp_path / "a.json", [fate], "0000000")
    assert json.loads((tmp_path / "a.json").read_text())["commit"] == "0000000"
    known = read_fates(tmp_path / "a.json")
    assert known == {MUTANTS[0].digest: fate} and replace(MUTANTS[0], replace="").digest not in known
    assert summarize([fate])[-1].endswith("1 of 1 killed")
