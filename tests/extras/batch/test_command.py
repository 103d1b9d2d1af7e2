"""The verb: what is run, what is not run again, and the tables at the end."""

from __future__ import annotations

import csv
import json
import re
import sys
from pathlib import Path

import pytest

import splatnode.extras.batch
from splatnode import command_line
from splatnode.capture.process.text import cell
from splatnode.extras.batch import LEDGER, BatchRecording, Ledger, OtherBatch, make_failed_outcome
from splatnode.extras.batch.command import CSV, EXIT_GOOD, EXIT_SOME_FAILED, run_batch, write_csv
from splatnode.extras.jobs import NOT_RUN
from splatnode.extras.verbs import replay_options
from tests.support.recordings import GOOD, REFUSED, options, simulated
from tests.support.synthetic import photographs


def ran(out: Path, *found: BatchRecording, command: tuple[str, ...] = ("act",), **changed) -> int:
    return run_batch(options(out, **changed), list(found), simulated, list(command))


def counted(name: str, tally: Path, then: str = GOOD) -> BatchRecording:
    """A recording that writes its name into a file each time that it is run."""
    return BatchRecording(name, f"echo {name} >> '{tally}'; {then}")


def table(out: Path) -> list[dict[str, str]]:
    with (out / "batch.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_tables_and_page_show_every_recording(tmp_path, capsys):
    out = tmp_path / "out"
    found = [
        BatchRecording("good", GOOD),
        BatchRecording("other", GOOD),
        BatchRecording("no", REFUSED),
        BatchRecording("bad", "exit 9"),
    ]
    assert ran(out, *found) == EXIT_SOME_FAILED
    said = capsys.readouterr().out
    assert "OK: 2; FAILED: 1; NO_OVERLAP: 1" in said and "4 of 4" in said and "bad: FAILED" in said
    rows = table(out)
    assert [(row["name"], row["verdict"]) for row in rows] == [
        ("good", "OK"),
        ("other", "OK"),
        ("bad", "FAILED"),
        ("no", "NO_OVERLAP"),
    ]
    assert rows[0]["rotation_deg"] == "0.1234" and rows[2]["rotation_deg"] == ""
    page = (out / "index.html").read_text()
    assert "4 recordings" in page and page.count("<tr") == 1 + 3 + 1 + 4
    assert "0.13°" in page and "1.5 %" in page and 'href="./bad.log"' in page and 'href="./good/"' in page


def test_parquet_has_the_same_rows(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")
    assert ran(tmp_path / "out", BatchRecording("good", GOOD), BatchRecording("bad", "exit 9")) == EXIT_SOME_FAILED
    rows = parquet.read_table(tmp_path / "out" / "batch.parquet").to_pylist()
    assert {row["name"]: row["gaussians"] for row in rows} == {"good": 1000, "bad": None}
    assert [row["verdict"] for row in rows] == [row["verdict"] for row in table(tmp_path / "out")]


def test_without_pyarrow_it_is_said_and_the_rest_is_there(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "splatnode.extras.batch.pyarrow", raising=False)
    monkeypatch.delattr(splatnode.extras.batch, "pyarrow", raising=False)
    assert ran(tmp_path / "out", BatchRecording("good", GOOD)) == EXIT_GOOD
    assert "no batch.parquet: pyarrow is not installed. Run: pip install 'splatnode[batch]'" in capsys.readouterr().out
    assert (tmp_path / "out" / "index.html").exists() and not (tmp_path / "out" / "batch.parquet").exists()


def test_the_page_shows_names_and_nothing_that_they_would_do(tmp_path):
    name = "<script>alert(1)</script>"
    assert ran(
        tmp_path / "out", BatchRecording(name.replace("/", "_"), GOOD), BatchRecording("b", f"echo '{name}'; exit 9")
    )
    page = (tmp_path / "out" / "index.html").read_text()
    assert "<script" not in page and "&lt;script&gt;alert(1)&lt;/script&gt;" in page


def test_resume_runs_what_has_not_come_to_an_end(tmp_path, capsys):
    out, tally = tmp_path / "out", tmp_path / "tally"
    first = [counted("a", tally), counted("b", tally, "exit 9")]
    ran(out, *first)
    assert ran(out, *first, counted("c", tally), resume=True) == EXIT_SOME_FAILED
    assert tally.read_text().split() == ["a", "b", "c"]
    assert "2 of 3 recordings came to an end before" in capsys.readouterr().out
    assert ran(out, *first, counted("c", tally), retry=True) == EXIT_SOME_FAILED
    assert tally.read_text().split() == ["a", "b", "c", "b"]
    assert [row["name"] for row in table(out)] == ["a", "c", "b"]


def test_half_a_line_of_a_killed_driver_is_forgotten(tmp_path):
    out, tally = tmp_path / "out", tmp_path / "tally"
    found = [counted("a", tally), counted("b", tally)]
    ran(out, *found)
    whole = (out / LEDGER).read_bytes()
    (out / LEDGER).write_bytes(whole[:-20])
    assert ran(out, *found, resume=True) == EXIT_GOOD
    assert tally.read_text().split() == ["a", "b", "b"]
    lines = (out / LEDGER).read_bytes().splitlines()
    assert len(lines) == 3 and all(json.loads(line) for line in lines)
    assert len(table(out)) == 2


def test_a_line_that_cannot_be_read_costs_only_its_recording(tmp_path, caplog):
    out, tally = tmp_path / "out", tmp_path / "tally"
    found = [counted("a", tally), counted("b", tally)]
    ran(out, *found)
    header, a, b = (out / LEDGER).read_bytes().splitlines(keepends=True)
    (out / LEDGER).write_bytes(header + b"\0" * (len(a) - 1) + b"\n" + b)
    assert ran(out, *found, resume=True) == EXIT_GOOD
    assert tally.read_text().split() == ["a", "b", "a"] and "line_unreadable" in caplog.text


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    out = tmp_path / "out"
    (out / "a").mkdir(parents=True)
    with pytest.raises(ValueError, match="must be a new or an empty folder, .* holds a; give another"):
        ran(out, BatchRecording("a", GOOD))
    with pytest.raises(ValueError, match="new or an empty"):
        ran(out, BatchRecording("a", GOOD), resume=True)
    assert [path.name for path in out.iterdir()] == ["a"]


def test_a_batch_that_the_release_before_began_is_resumed(tmp_path):
    former = ["splatnode", "replay", "--require", "2.5", "--quick", "--only-seen"]
    present = ["splatnode", "replay", "--max-position-error", "2.5", "--no-fallbacks", "--multi-view-only"]
    with Ledger(tmp_path, former):
        pass
    with Ledger(tmp_path, present):
        pass
    with pytest.raises(OtherBatch, match="other options"):
        Ledger(tmp_path, [*present, "--size", "64"]).__enter__()


def test_a_batch_is_not_begun_twice_nor_gone_on_with_otherwise(tmp_path):
    out = tmp_path / "out"
    ran(out, BatchRecording("a", GOOD))
    with pytest.raises(ValueError, match="holds a batch already; --resume goes on"):
        ran(out, BatchRecording("a", GOOD))
    with pytest.raises(OtherBatch, match="of a batch with other options: act. Now they are act --size 64"):
        ran(out, BatchRecording("a", GOOD), resume=True, command=("act", "--size", "64"))
    (out / LEDGER).write_text("[]\n")
    with pytest.raises(OtherBatch, match="is not the ledger of a batch"):
        ran(out, BatchRecording("a", GOOD), resume=True)


def test_there_are_no_more_cores_than_there_are(tmp_path):
    with pytest.raises(ValueError, match="--cores must be at most [0-9]+, .* got 100000"):
        ran(tmp_path / "out", BatchRecording("a", GOOD), cores=100_000)


def test_programs_get_the_counts(tmp_path, capsys):
    assert ran(tmp_path / "out", BatchRecording("a", GOOD), BatchRecording("b", REFUSED), json=True) == EXIT_GOOD
    assert json.loads(capsys.readouterr().out) == {"recordings": 2, "verdicts": {"NO_OVERLAP": 1, "OK": 1}}


def test_each_replay_gets_the_options_that_were_given():
    given = [
        "--preset",
        "preview",
        "--size",
        "320",
        "--max-position-error",
        "2.5",
        "--no-fallbacks",
        "--multi-view-only",
        "--views",
        "6",
    ]
    parser = command_line.build_parser()
    made = replay_options(parser.parse_args(["batch", "a", "--out", "b", *given]))
    assert sorted(made) == sorted(given)
    there = parser.parse_args(["replay", "a", "--out", "b", *made])
    assert (there.preset, there.size, there.max_position_error, there.no_fallbacks, there.views) == (
        "preview",
        320,
        2.5,
        True,
        6,
    )
    assert replay_options(parser.parse_args(["batch", "a", "--out", "b", "--resume", "--cores", "1"])) == []


def test_folders_of_photographs_become_results(tmp_path, capsys):
    import cv2

    for name, count in (("place/images", 4), ("single", 1)):
        folder = tmp_path / "recordings" / name
        folder.mkdir(parents=True)
        for frame in photographs()[:count]:
            cv2.imwrite(str(folder / frame.name), frame.image[:, :, ::-1])
    out = tmp_path / "out"
    argv = ["batch", str(tmp_path / "recordings"), "--out", str(out), "--preset", "preview", "--cores", "1"]
    assert command_line.main(argv) == EXIT_GOOD
    rows = {row["name"]: row for row in table(out)}
    assert rows["place"]["verdict"] == "OK" and rows["place"]["photographs"] == "4"
    assert rows["single"]["verdict"] == "TOO_FEW_VIEWS" and rows["single"]["published"] == "False"
    assert (out / "place" / "scene.ply").exists() and (out / "single" / "report.json").exists()
    page = (out / "index.html").read_text()
    assert len(re.findall('src="data:image/jpeg;base64,', page)) == 2
    assert float(rows["place"]["seconds"]) > float(rows["place"]["reconstruction_s"]) > 0


@pytest.mark.parametrize("name", ["=1+1", "+1", "-1", "@SUM(1)", "\t=1"])
def test_a_table_has_no_formula(tmp_path, name):
    write_csv(tmp_path / CSV, [make_failed_outcome(BatchRecording(name, "/a"), NOT_RUN, "=cmd()")])
    with (tmp_path / CSV).open(newline="", encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert row["name"] == f"'{name}" and row["message"] == "'=cmd()" and row["source"] == "/a"
    assert cell(-0.5) == -0.5 and cell("a-1") == "a-1"


def test_a_table_and_the_ledger_are_written_through_no_link(tmp_path):
    out, mine = tmp_path / "out", tmp_path / "mine"
    mine.write_text("mine")
    out.mkdir()
    for name in (CSV, f".{CSV}.partial", LEDGER):
        (out / name).symlink_to(mine)
    write_csv(out / CSV, [])
    assert not (out / CSV).is_symlink() and (out / CSV).read_text().startswith("name,")
    with pytest.raises(OSError, match="remove it"):
        Ledger(out, ["act"])
    assert mine.read_text() == "mine"
