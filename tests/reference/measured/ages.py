"""How old the raw files are: the commit that last wrote each, by day."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

from tests.conftest import ROOT
from tests.reference.measured.raw import RESULTS, table

PAGE = ROOT / "docs" / "measurement.md"
UNCOMMITTED = "0000000"  # of a raw file that no commit has yet
ENTRY = re.compile(r"`([\w.]+)` ([0-9a-f]{7,})")


def list_raw_files() -> list[Path]:
    """Returns the raw files that are figures; those of the fit are its samples, and are compressed."""
    return sorted([*RESULTS.glob("*.json"), *RESULTS.glob("lens_assumptions*.json.gz")])


def read_commits(text: str) -> dict[str, str]:
    """Returns the commit that a page gives, by raw file."""
    _, _, section = text.partition("<!-- table: ages -->")
    return dict(ENTRY.findall(section.partition("<!-- end -->")[0]))


def is_content_of(path: Path, commit: str) -> bool:
    """Returns whether the file is what that commit has."""
    name = path.relative_to(ROOT).as_posix()
    return not _run_git("diff", "--quiet", commit, "--", name).returncode


def has_commit(commit: str) -> bool:
    """Returns whether this checkout knows a commit; one without the whole history may not."""
    return not _run_git("cat-file", "-e", f"{commit}^{{commit}}").returncode


def is_in_history(commit: str) -> bool:
    """Returns whether a commit leads to the present one: one that was amended away does not."""
    return not _run_git("merge-base", "--is-ancestor", commit, "HEAD").returncode


def ages() -> str:
    """The commit that last wrote each raw file, by its day; what stands on the page is kept while it is true."""
    kept = read_commits(PAGE.read_text(encoding="utf-8"))
    days: dict[str, list[str]] = {}
    for path in list_raw_files():
        commit = kept.get(path.name)
        if commit in (None, UNCOMMITTED) or (
            has_commit(commit) and not (is_in_history(commit) and is_content_of(path, commit))
        ):
            commit = _run_git("log", "-1", "--format=%h", "--", str(path)).stdout.strip() or UNCOMMITTED
        day = _run_git("log", "-1", "--format=%cs", commit).stdout.strip() or _find_day(path.name)
        days.setdefault(day, []).append(f"`{path.name}` {commit}")
    return table(("day", "raw file and commit"), [(day, ", ".join(found)) for day, found in sorted(days.items())])


def _may_hold(path: Path, commit: str) -> bool:
    """Returns whether the commit has this content, as far as this checkout knows it."""
    return not has_commit(commit) or (is_in_history(commit) and is_content_of(path, commit))


def _find_day(name: str) -> str:
    """Returns the day that the page gives, for a checkout without history."""
    row = re.search(rf"^\| (\S+) \|.*`{re.escape(name)}`", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return row[1] if row else "unknown"


def _run_git(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)


BLOCKS = (ages,)
