"""Charts are drawn from bench.json alone; means and fronts are worked out by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from recon.evaluate.summary import markdown, points

pytest.importorskip("matplotlib", reason="charts need matplotlib (pip install 'splatnode[bench]')")

from recon.evaluate.charts import draw, main, pareto_front, speed_accuracy


def row(method: str, checkpoint: int | None, psnr: float | None, seconds: float | None, **other) -> dict:
    return {
        **{"scene": "a", "views": 3, "method": method, "seed": 0, "checkpoint": checkpoint, "verdict": "OK"},
        **{"psnr": psnr, "ssim": 0.8, "lpips_alex": None, "lpips_vgg": None, "peak_rss_mb": 500.0},
        **{"rotation_error_deg": 0.5, "centre_error_pct": 1.0, "focal_error_pct": None},
        **{"seconds": {"total": seconds}, "num_gaussians": 1000, "scene_bytes": 68000},
        **other,
    }


ROWS = [
    row("fast", 100, 20.0, 1.0),
    row("fast", None, 22.0, 2.0),
    row("fast", None, 24.0, 4.0, scene="b"),  # ended before its checkpoint
    row("slow", None, 26.0, 10.0),
    row("slow", None, None, None, scene="b", verdict="NO_OVERLAP", scene_bytes=0),
]


def bench(folder: Path, rows: list[dict]) -> Path:
    content = {"rows": rows, "settings": {"alignment_steps": 500, "longer_side": 512}, "machine": {}, "command": "c"}
    path = folder / "bench.json"
    path.write_text(json.dumps(content))
    return path


def test_means_are_over_the_same_runs_at_every_point():
    found = {(p.method, p.checkpoint): p for p in points(ROWS)}
    assert list(found) == [("fast", 100), ("fast", None), ("slow", None)]
    assert found["fast", 100].psnr == 22.0  # 20 at the checkpoint, and 24 of the run that was over by then
    assert found["fast", 100].seconds == 2.5
    assert found["fast", None].psnr == 23.0
    assert found["fast", None].scene_megabytes == pytest.approx(0.068)
    assert (found["slow", None].solved, found["slow", None].runs) == (1, 2)
    assert found["slow", None].seconds == 10.0
    assert found["slow", None].lpips_vgg is None and found["slow", None].focal_error_pct is None


def test_pareto_front_keeps_what_nothing_beats():
    pairs = [(1.0, 20.0), (2.0, 19.0), (3.0, 22.0), (3.0, 21.0), (4.0, 22.0)]
    assert pareto_front(pairs, higher_is_better=True) == [(1.0, 20.0), (3.0, 22.0)]
    assert pareto_front(pairs, higher_is_better=False) == [(1.0, 20.0), (2.0, 19.0)]
    assert pareto_front([], higher_is_better=True) == []


def test_charts_are_drawn_from_the_file_alone(tmp_path):
    charts = draw(bench(tmp_path, ROWS), tmp_path / "out")
    assert [path.name for path in charts] == ["speed_accuracy.png", "parsimony.png"]
    for path in charts:
        assert path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000


def test_every_curve_has_every_moment_and_lpips_only_where_measured():
    axes = speed_accuracy([p for p in points(ROWS) if p.psnr is not None]).axes
    assert [a.get_ylabel() for a in axes] == ["PSNR (dB)", "SSIM"]
    curves = [tuple(np.asarray(data).tolist() for data in line.get_data()) for line in axes[0].lines]
    assert ([2.5, 3.0], [22.0, 23.0]) in curves and ([10.0], [26.0]) in curves
    measured = [{**r, "lpips_vgg": 0.2} for r in ROWS]
    axes = speed_accuracy(points(measured)[:2]).axes
    assert axes[2].get_ylabel() == "LPIPS VGG (axis turned)" and axes[2].yaxis_inverted()


def test_bench_without_a_scored_scene_has_nothing_to_draw(tmp_path):
    with pytest.raises(ValueError, match="must have a row with a scored scene"):
        draw(bench(tmp_path, ROWS[-1:]), tmp_path)


def test_command_line_draws(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["charts", str(bench(tmp_path, ROWS)), "--out", str(tmp_path / "out")])
    main()
    assert capsys.readouterr().out.split() == [
        str(tmp_path / "out" / "speed_accuracy.png"),
        str(tmp_path / "out" / "parsimony.png"),
    ]


def test_report_has_a_table_and_says_what_was_not_measured(tmp_path):
    text = markdown(json.loads(bench(tmp_path, ROWS).read_text()))
    assert "| slow | 1/2 | 10.0 | 26.00 | 0.8000 | – | – | 0.50 | 1.00 | – | 1 000 | 0.1 | 500 |" in text
    assert "| b | 3 | slow | 0 | NO_OVERLAP | – | – |" in text
