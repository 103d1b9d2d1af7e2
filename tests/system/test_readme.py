"""Every measured figure that README and the guides print is that of its raw file in tests/bench/results.

Each test makes rows and phrases from the raw numbers, rounded as they are printed, and looks for them on the page. What
is between the marks of a page is made by `python -m tests.reference`: see tests/reference/test_measured.py.
"""

from __future__ import annotations

import re

from tests.conftest import ROOT
from tests.reference.measured import race
from tests.reference.measured.raw import ends, part, raw
from tests.reference.measured.scenes import average_recipe

MEASUREMENT, README = "docs/measurement.md", "README.md"


def says(*phrases: str, on: str) -> None:
    text = re.sub(r"\s+", " ", (ROOT / on).read_text(encoding="utf-8"))  # a phrase may be broken into lines anywhere
    missing = [phrase for phrase in phrases if phrase not in text]
    assert not missing, f"{on} must say {missing}"


def test_how_the_rivals_are_cut_down():
    from splatnode.extras.evaluate.rivals import cf_3dgs, colmap_3dgs, colmap_fsgs, nerfmm
    from splatnode.recon.optimize.control import adaptive

    assert colmap_3dgs.OPTIMIZE.iterations == colmap_fsgs.OPTIMIZE.iterations == nerfmm.OPTIMIZE.iterations == 1500
    assert (adaptive.Config().max_gaussians, nerfmm.OPTIMIZE.rays, nerfmm.SIZE) == (100_000, 384, 256)
    film = cf_3dgs.Config()
    says(
        f"CF-3DGS to {film.alone} iterations a frame, {film.motion} a motion and {film.final} at the end",
        on=MEASUREMENT,
    )


def test_needles():
    covered = {(row["scene"], row["label"]): row["covered_pct"] for row in raw("needles")["rows"]}
    rows = []
    for scene in dict.fromkeys(scene for scene, _ in covered):
        values = (covered.get((scene, label)) for label in ("main", "only-seen"))
        rows.append(f"| {scene} | " + " | ".join("–" if value is None else part(value, 2) for value in values) + " |")
    says(*rows, on="docs/clean_scenes.md")


def test_all_rows_of_a_case_of_the_race_start_from_the_same_cameras():
    assert race.find_unlike_cases() == []


def test_a_cluster_that_loses_a_worker_and_a_node():
    row = raw("batch_ray")
    simulated, real = row["simulated"], row["real"]
    for each in (simulated, real):
        assert each["ledger_lines"] == each["recordings"] and each["hidden_files_left"] == each["other_folders"] == 0
    assert simulated["rows"] == simulated["as_expected"] == simulated["recordings"]
    count = simulated["recordings"]
    some, of_each, same = real["recordings"], (real["windows"], real["built_in"]), real["the_same_to_the_bit"]
    assert real["rows"] == real["results_whole"] == some == sum(of_each) == real["compared_with_replay_alone"]
    assert same == some and not real["others"]
    says(
        f"{some} real recordings, {of_each[0]} windows of three photographs and {of_each[1]} built-in captures",
        f"{some} of {some} have their one result, {real['with_a_scene']} of them a scene",
        f"{some} were replayed alone, too: {same} of {some} are the same to the bit",
        on="docs/cluster.md",
    )
    says(
        f"{count} simulated recordings, of which a worker was killed with -9 and a node removed",
        f"{simulated['repeated']} began twice",
        on="docs/cluster.md",
    )


def test_the_trials_of_a_core_hour():
    row = raw("campaign")
    count, in_an_hour = row["trials"], row["trials_in_a_core_hour"]
    assert sum(row["outcomes"].values()) == count and "failed" not in row["outcomes"]
    assert count % row["kinds"] == 0 and round(3600 * count / row["processor_seconds"], -1) == round(in_an_hour, -1)
    assert 0.45 < row["outcomes"]["accepted"] / count < 0.6  # one in two
    says(f"| {in_an_hour}: 10 000 take {10_000 / in_an_hour:.1f} core-hours |", on="docs/cluster.md")


def test_a_simulated_batch():
    row = raw("batch_simulation")
    last, count = row["last_life"], f"{row['recordings']:,}".replace(",", " ")
    assert row["rows"] == row["as_expected"] == row["recordings"] == 10_000 and row["hidden_files_left"] == 0
    assert row["results_whole"] == row["rows"] - row["verdicts"]["FAILED"]
    memory = last["memory_mb_after_a_tenth"], last["memory_mb_at_the_last_recording"]
    assert memory[1] < 1.05 * memory[0] and row["repeated_percent"] < 1
    says(
        f"In a simulation of {count} recordings whose batch was killed {row['kills_of_the_driver']} times, "
        f"{row['repeated']} were repeated, and the process that starts them took {memory[0]:.0f} MB "
        f"after a tenth and {memory[1]:.0f} MB at the end",
        on="docs/batch.md",
    )


def test_what_a_thousand_recordings_take():
    seconds = round(average_recipe(ends("bench_7sets", method="balanced"))["seconds"])
    hours = 1000 * seconds / 3600
    says(
        f"| {seconds} s |",
        f"3600 / {seconds} = {int(3600 / seconds)} recordings",
        f"1000 × {seconds} / 3600 = {hours:.1f} core-hours",
        on="docs/batch.md",
    )
    most_mb = max(row["peak_rss_mb"] for row in raw("replay")["rows"])
    says(f"`fast` and `balanced`) | {most_mb / 1000:.1f} GB", on="docs/batch.md")
