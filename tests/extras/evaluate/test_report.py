"""What somebody named is text in a report: no markup, no cell of a table, no address of its own."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser
from urllib.parse import unquote_to_bytes

import pytest

from splatnode.extras.evaluate.protocol import ExposureScore, Row, Settings
from splatnode.extras.evaluate.report import FOLDER, PHOTOGRAPH, Bench, make_bench_files, make_report_files
from tests.support.hostile import TEXTS, unprintable

NAMES = {what: text.replace("\x00", "").replace("/", "_")[:100] for what, text in TEXTS.items()}
ALLOWED = {"html", "head", "meta", "title", "style", "body", "h1", "h2", "p", "code", "img", "table", "tr", "th", "td",
           "div", "figure", "figcaption"}  # fmt: skip


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.sources: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}
        self.sources += [value or "" for name, value in attrs if name == "src"]


def row(scene: str, method: str) -> Row:
    return Row(
        scene=scene, views=3, method=method, seed=0, checkpoint=None, final=True, psnr=30.0, ssim=0.9, verdict=scene,
        seconds={"total": 1.0}, peak_rss_mb=1.0,
    )  # fmt: skip


def test_scores_in_other_exposures_have_a_table_and_columns_of_their_own(tmp_path):
    scores = {
        "raw": ExposureScore(30.0, 0.9, 0.1, 9.0),
        "interpolated": ExposureScore(31.5, 0.91, 0.1, 1.5),
        "best_gain": ExposureScore(32.25, 0.92, 0.1, 0.0),
    }
    bench = Bench((replace(row("place", "ours"), exposures=scores), row("place", "old")), Settings(), {}, "bench")
    text = make_report_files(bench, tmp_path)["report.md"].decode()
    assert "| 3 | ours | 30.00 | 31.50 | 32.25 | 0.9000 | 0.9100 | 0.9200 | 1.5 |" in text
    table = make_bench_files(bench)["bench.csv"].decode().splitlines()
    assert "interpolated_psnr" in table[0] and "31.5" in table[1] and "31.5" not in table[2]
    assert (
        "Exposure"
        not in make_report_files(Bench(bench.rows[1:], Settings(), {}, "bench"), tmp_path)["report.md"].decode()
    )


@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_a_hostile_name_is_text(tmp_path, name):
    chart = f"{name[:50]}.png"
    (tmp_path / chart).write_bytes(b"")
    view = tmp_path / FOLDER / "scene-3" / name[:50]
    view.mkdir(parents=True)
    for picture in (PHOTOGRAPH, "method-0.jpg"):
        (view / picture).write_bytes(b"")
    bench = Bench((row(name, name), row("scene", "method")), Settings(), {"processor": name, "threads": name}, name)
    files = make_report_files(bench, tmp_path)
    for file in files.values():
        assert not unprintable(file.decode())
    page = Page(files["report.html"].decode())
    assert page.tags <= ALLOWED and page.attributes <= {"charset", "src", "alt", "loading"}
    assert {unquote_to_bytes(source).decode(errors="surrogateescape") for source in page.sources} >= {
        chart,
        f"{FOLDER}/scene-3/{name[:50]}/{PHOTOGRAPH}",
    }
    tables = [line for line in files["report.md"].decode().splitlines() if line.startswith("|")]
    assert all(line.replace("\\|", "").count("|") >= 5 and "<" not in line for line in tables)


def test_names_that_a_page_can_show_stay_as_they_are(tmp_path):
    page = make_report_files(Bench((row("Küche 3", "ours"),), Settings(), {}, "bench"), tmp_path)
    assert "<td>Küche 3</td>" in page["report.html"].decode() and "| Küche 3 |" in page["report.md"].decode()


def test_renders_of_an_earlier_run_are_not_shown_beside_a_refusal(tmp_path):
    for method in ("ours", "theirs"):
        view = tmp_path / FOLDER / "a-3" / "view"
        view.mkdir(parents=True, exist_ok=True)
        for picture in (PHOTOGRAPH, f"{method}-0.jpg"):
            (view / picture).write_bytes(b"")
    rows = row("a", "ours"), replace(row("a", "theirs"), psnr=None, ssim=None, verdict="NO_OVERLAP")
    page = Page(make_report_files(Bench(rows, Settings(), {}, "bench"), tmp_path)["report.html"].decode())
    assert page.sources == [f"{FOLDER}/a-3/view/{PHOTOGRAPH}", f"{FOLDER}/a-3/view/ours-0.jpg"]
