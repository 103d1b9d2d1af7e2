"""Charts are drawn from bench.json alone; means and fronts are worked out by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from splatnode.extras.evaluate.protocol import Row, Settings
from splatnode.extras.evaluate.report import (
    PSNR,
    Bench,
    compute_method_means,
    compute_paired_changes,
    make_bench_files,
    make_tables,
    make_views_table,
    merge_benches,
    read_bench,
    redraw,
    select_shared_runs,
)

pytest.importorskip("matplotlib", reason="charts need matplotlib (pip install 'splatnode[bench]')")

from matplotlib.patches import Rectangle

from splatnode.extras.evaluate.charts import draw, draw_ablation, draw_speed_accuracy, find_pareto_front


def row(method: str, checkpoint: int | None, psnr: float | None, seconds: float | None, **other) -> Row:
    usual = {
        **{"scene": "a", "views": 3, "method": method, "seed": 0, "checkpoint": checkpoint, "verdict": "OK"},
        **{"final": checkpoint is None, "psnr": psnr, "ssim": 0.8, "peak_rss_mb": 500.0},
        **{"rotation_error_deg": 0.5, "centre_error_pct": 1.0},
        **{"seconds": {"total": seconds}, "num_gaussians": 1000, "scene_bytes": 68000},
    }
    return Row(**(usual | other))


ROWS = [
    row("fast", 100, 20.0, 1.0),
    row("fast", None, 22.0, 2.0),
    row("fast", None, 24.0, 4.0, scene="b"),  # ended before its checkpoint
    row("slow", None, 26.0, 10.0),
    row("slow", None, None, None, scene="b", verdict="NO_OVERLAP", scene_bytes=0),
]


def bench(*rows: Row) -> Bench:
    return Bench(rows, Settings(), {"processor": "P", "threads": 2}, "splatnode bench")


def test_means_are_over_the_same_runs_at_every_point():
    found = {(p.method, p.checkpoint): p for p in compute_method_means(ROWS)}
    assert list(found) == [("fast", 100), ("fast", None), ("slow", None)]
    assert found["fast", 100].psnr == 22.0  # 20 at the checkpoint, and 24 of the run that was over by then
    assert found["fast", 100].seconds == 2.5
    assert found["fast", None].psnr == 23.0
    assert found["fast", None].scene_megabytes == pytest.approx(0.068)
    assert (found["slow", None].solved, found["slow", None].runs) == (1, 2)
    assert found["slow", None].seconds == 10.0
    assert found["slow", None].lpips_vgg is None and found["slow", None].focal_error_pct is None


def test_methods_are_compared_on_the_runs_that_all_were_put_to():
    rows = [*ROWS, row("slow", None, 10.0, 1.0, scene="hard"), row("slow", None, 30.0, 1.0, views=6)]
    assert {r.scene for r in select_shared_runs(rows) if r.views == 3} == {"a", "b"}
    assert [r.views for r in select_shared_runs(rows)].count(6) == 1
    apart = [row("fast", None, 20.0, 1.0), row("slow", None, 30.0, 1.0, scene="b")]
    assert select_shared_runs(apart) == apart


def test_pareto_front_keeps_what_nothing_beats():
    pairs = [(1.0, 20.0), (2.0, 19.0), (3.0, 22.0), (3.0, 21.0), (4.0, 22.0)]
    assert find_pareto_front(pairs, higher_is_better=True) == [(1.0, 20.0), (3.0, 22.0)]
    assert find_pareto_front(pairs, higher_is_better=False) == [(1.0, 20.0), (2.0, 19.0)]
    assert find_pareto_front([], higher_is_better=True) == []


def test_charts_are_drawn_from_the_rows_alone():
    charts = draw(ROWS)
    assert list(charts) == ["speed_accuracy.png", "parsimony.png"]
    for png in charts.values():
        assert png.startswith(b"\x89PNG") and len(png) > 10_000
    assert draw(ROWS[-1:]) == {}  # nothing was scored
    field = row("nerfmm", None, 18.0, 60.0, num_gaussians=0)
    assert list(draw([field])) == ["speed_accuracy.png"]


def test_every_curve_has_every_moment_and_lpips_only_where_measured():
    axes = draw_speed_accuracy([p for p in compute_method_means(ROWS) if p.psnr is not None]).axes
    assert [a.get_ylabel() for a in axes] == ["PSNR (dB)", "SSIM"]
    curves = [tuple(np.asarray(data).tolist() for data in line.get_data()) for line in axes[0].lines]
    assert ([2.5, 3.0], [22.0, 23.0]) in curves and ([10.0], [26.0]) in curves
    measured = [replace(r, lpips_vgg=0.2) for r in ROWS]
    axes = draw_speed_accuracy(compute_method_means(measured)[:2]).axes
    assert axes[2].get_ylabel() == "LPIPS VGG (axis turned)" and axes[2].yaxis_inverted()
    ends_alone = [replace(r, lpips_alex=0.1, lpips_vgg=0.2 if r.final else None) for r in ROWS]
    assert draw_speed_accuracy(compute_method_means(ends_alone)).axes[2].get_ylabel() == "LPIPS Alex (axis turned)"


ABLATION = [
    row("instantsplat-xl", None, 20.0, 1.0),
    row("instantsplat-xl", None, 22.0, 1.0, scene="b"),
    row("instantsplat-xl+depth", None, 20.5, 1.0),
    row("instantsplat-xl+depth", None, 21.0, 1.0, scene="b"),
    row("paper", None, 21.0, 2.0),
    row("paper-depth", None, 20.8, 2.0),
    row("paper-depth", None, 30.0, 2.0, seed=1),  # the whole has no such run
]


def test_ablation_compares_run_by_run():
    assert compute_paired_changes(ABLATION, "instantsplat-xl+depth", "instantsplat-xl", PSNR) == [0.5, -1.0]
    assert compute_paired_changes(ABLATION, "paper-depth", "paper", PSNR) == [pytest.approx(-0.2)]
    assert list(draw(ABLATION)) == ["speed_accuracy.png", "parsimony.png", "ablation.png"]
    chart = draw_ablation(ABLATION).axes[0]
    labels = [label.get_text() for label in chart.get_yticklabels()]
    assert labels == [
        "instantsplat-xl+depth  vs. instantsplat-xl",
        "paper  vs. instantsplat-xl",
        "paper-depth  vs. paper",
    ]
    assert [bar.get_width() for bar in chart.patches if isinstance(bar, Rectangle)] == pytest.approx([-0.25, 1.0, -0.2])
    told = {table.title: table.body for table in make_tables(ABLATION)}["Ablation"]
    assert ("instantsplat-xl+depth", "instantsplat-xl", "20.75", "-0.25", "0.8000", "+0.0000", "2") in told


def test_the_papers_tables():
    """Methods down, measures and numbers of views across; mean and spread are over seeds, of means over scenes."""
    rows = [
        row("fast", None, 20.0, 1.0, ssim=0.6, ate_instantsplat=0.02),
        row("fast", None, 22.0, 1.0, ssim=0.8, scene="b", ate_instantsplat=0.04),
        row("fast", None, 23.0, 1.0, ssim=0.9, seed=1),
        row("fast", None, 25.0, 1.0, ssim=0.95, views=6),
        row("slow", None, 21.0, 1.0, ssim=0.7),
    ]
    told = make_views_table(rows)
    assert told.head[:3] == ("method", "SSIM 3", "SSIM 6")
    cells = dict(zip(told.head, told.body[0], strict=True))
    assert cells["SSIM 3"] == "0.8000 ± 0.1414" and cells["SSIM 6"] == "0.9500"
    assert cells["PSNR 3"] == "22.00 ± 1.41" and cells["ATE 3"] == "0.0300"
    by_place = {table.title: table for table in make_tables(rows)}["Scene by scene, 3 views"]
    assert by_place.head == ("measure", "method", "a", "b")
    assert ("PSNR", "fast", "21.50 ± 2.12", "22.00") in by_place.body
    assert ("PSNR", "slow", "21.00", "–") in by_place.body


def test_report_has_a_table_and_says_what_was_not_measured(tmp_path):
    redraw(bench(*ROWS), tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "| slow | 1/2 | 10.0 | 26.00 | 0.8000 | – | – | 0.50 | 1.00 | – | 1 000 | 0.1 | 500 |" in text
    assert "| b | 3 | slow | 0 | NO_OVERLAP | – | – |" in text
    page = (tmp_path / "report.html").read_text()
    assert '<img src="speed_accuracy.png"' in page and "<td>26.00</td>" in page


def test_everything_is_drawn_again_from_the_file(tmp_path):
    redraw(bench(*ROWS), tmp_path / "first")
    redraw(read_bench(tmp_path / "first" / "bench.json"), tmp_path / "second")
    names = {path.name for path in (tmp_path / "first").iterdir()}
    assert names == {"bench.json", "bench.csv", "report.md", "report.html", "speed_accuracy.png", "parsimony.png"}
    for name in names:
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()
    (tmp_path / "other.json").write_text('{"trials": []}')
    with pytest.raises(ValueError, match=r"must be the bench\.json of a benchmark"):
        read_bench(tmp_path / "other.json")


def test_pieces_of_a_benchmark_are_put_together():
    first, again = bench(*ROWS), bench(row("fast", 100, 21.0, 1.0), row("fast", None, 22.5, 2.0))
    rows = merge_benches([first, again]).rows
    assert [(r.scene, r.method, r.psnr) for r in rows] == [
        *(("b", "fast", 24.0), ("a", "slow", 26.0), ("b", "slow", None)),
        *(("a", "fast", 21.0), ("a", "fast", 22.5)),
    ]
    with pytest.raises(ValueError, match="scored alike"):
        merge_benches([first, Bench((), Settings(alignment_steps=1), {}, "")])


def test_rows_of_an_older_benchmark_lack_what_was_measured_later(tmp_path):
    content = json.loads(make_bench_files(bench(*ROWS))["bench.json"])
    for record in content["rows"]:
        del record["psnr_with_rim"]
    (tmp_path / "old.json").write_text(json.dumps(content))
    both = merge_benches([read_bench(tmp_path / "old.json"), bench(row("other", None, 20.0, 1.0, psnr_with_rim=19.0))])
    lines = make_bench_files(both)["bench.csv"].decode().splitlines()
    assert len(lines) == 1 + len(ROWS) + 1 and "psnr_with_rim" in lines[0]
