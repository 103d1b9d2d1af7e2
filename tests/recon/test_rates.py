"""The seconds of each step: what is measured, how it is written, and what is refused."""

import json
from functools import partial

import pytest

from splatnode import command_line
from splatnode.capture.cameras import synthetic
from splatnode.recon import doctor
from splatnode.recon.config import apply_changes, preset
from splatnode.recon.doctor import Rates, format_rates, measure_rates, record_rates

SOME = Rates(6, 0.2, 0.75, 0.05, "5 of 5", 12.0, None, "OK_ROUGH", 9000)


def test_every_step_is_measured(monkeypatch):
    monkeypatch.setattr(synthetic, "Config", partial(synthetic.Config, width=320, height=240))
    (found,) = measure_rates((4,), apply_changes(preset("preview"), {"optimize": {"iterations": 10}}))
    assert found.views == 4 and found.verdict.startswith("OK") and found.gaussians > 0
    assert min(found.add_s, found.update_s, found.finalize_s, found.localize_s) > 0
    assert found.localized == "3 of 3"


def test_the_table_has_a_line_for_each_number_of_views():
    titles, line = format_rates([SOME])
    assert titles.split() == ["views", "add", "update", "localize", "finalize", "map"]
    assert line.split() == ["6", "0.20", "s", "0.75", "s", "0.05", "s", "12.00", "s", "-"]


@pytest.mark.parametrize("views", ["1", "49"])
def test_a_number_of_views_that_makes_no_scene_is_refused(views, capsys):
    assert command_line.main(["doctor", "--rates", views]) == 2
    assert f"--rates must be numbers of views from 2 to 48, got {views}" in capsys.readouterr().err


def test_programs_get_the_rates_with_the_machine(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "measure_rates", lambda views, tell: [SOME] if views == (3, 6, 12) else [])
    assert command_line.main(["doctor", "--rates", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == record_rates([SOME])
    assert told["rates"][0]["map_s"] is None and told["machine"]["threads"] >= 1


def test_people_get_the_table_and_the_machine(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "measure_rates", lambda views, tell: [SOME])
    assert command_line.main(["doctor", "--rates", "6"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == format_rates([SOME]) and "The built-in capture" in lines[2]
