"""Table and plot of a sweep, and members that are not finished; figures are made up."""

import dataclasses
import json
import re

import pytest

from calib.arm import CalibratedArm
from mjx_softarm._support.provenance import write_json
from tests.train.small import CONFIG, SHORT
from train.runs.checkpoint import RunError
from train.runs.evaluate import Summary
from train.sweep.command import members_of
from train.sweep.report import RESULTS_FILE, by_settings, curves, report
from train.sweep.run import create

AT_REST = [field.name for field in dataclasses.fields(Summary) if field.default is dataclasses.MISSING]
MEDIANS = {(0, 0.5): [9.0, 2.0], (1, 0.5): [7.0, 5.0], (0, 0.9): [8.0, 6.0], (1, 0.9): [6.0, 8.0]}


@pytest.fixture
def finished(tmp_path):
    """A sweep of two seeds and two settings with figures made up."""
    members, varied = members_of(CONFIG, (0, 1), ["learner.gamma=0.5,0.9"])
    sweep = create(tmp_path / "sweep", members, varied, CalibratedArm(SHORT))
    for run in sweep.runs:
        medians = MEDIANS[run.config.seed, run.config.learner.gamma]
        for epoch, median in enumerate(medians, start=1):
            run.log({"epoch": epoch, "env_steps": 64 * epoch, "updates": 10, "evaluation/median_mm": median})
        run.log({"epoch": 3, "env_steps": 192, "updates": 30})
        own = {"p95_mm": 10.0 + run.config.seed, "reached_share": 0.25 * (1 + run.config.seed)}
        figures = dict.fromkeys(AT_REST, 0.0) | {"median_mm": medians[-1], "circle_mean_mm": 1.0} | own
        write_json(run.path / "evaluation.json", figures)
    return sweep


def test_the_table_has_mean_least_and_greatest_over_the_seeds(finished):
    shown = report(finished)
    columns = {str(column.header).replace("\n", " "): list(column.cells) for column in shown.columns}
    assert columns == {
        "setting": ["learner.gamma=0.5", "learner.gamma=0.9"],
        "tip error, median [mm]": ["3.50\n(2.00 to 5.00)", "7.00\n(6.00 to 8.00)"],
        "95 % [mm]": ["10.50\n(10.00 to 11.00)"] * 2,
        "goals reached [%]": ["37.5\n(25.0 to 50.0)"] * 2,
        "saturated [%]": ["0.0\n(0.0 to 0.0)"] * 2,
        "uniform in volume [mm]": ["0.00\n(0.00 to 0.00)"] * 2,
        "circle, mean [mm]": ["1.00\n(1.00 to 1.00)"] * 2,
    }
    written = json.loads((finished.path / RESULTS_FILE).read_text())
    assert {"python", "packages", "commit"} <= written["provenance"].keys()
    first, second = written["groups"]
    assert first["settings"] == {"learner.gamma": 0.5} and second["settings"] == {"learner.gamma": 0.9}
    assert first["over_seeds"]["median_mm"] == {"mean": 3.5, "min": 2.0, "max": 5.0}
    assert [run["env_steps"] for run in first["runs"]] == [192, 192]


def test_further_evaluations_are_told_where_all_seeds_have_them(finished):
    figures = dict.fromkeys(AT_REST, 0.0) | {"near_share": 1.0, "near_median_s": None, "median_mm": 4.0}
    names = ["evaluation-500g", "evaluation-in-motion-4x0.5s"]
    for run in finished.runs[:3]:
        for name in names[run.config.seed :]:
            write_json(run.path / f"{name}.json", figures)
    first, second = by_settings(finished.runs, lambda run: {"gamma": run.config.learner.gamma})
    assert first.keys() == {"settings", "runs", "over_seeds", f"{names[1]}_over_seeds"}
    spread = first[f"{names[1]}_over_seeds"]
    assert spread["median_mm"]["mean"] == 4.0 and spread["near_share"]["min"] == 1.0
    assert "near_median_s" not in spread and "near_share" not in first["over_seeds"]
    assert second.keys() == {"settings", "runs", "over_seeds"}
    assert second["runs"][0]["evaluation-500g"]["median_mm"] == 4.0


def test_the_plot_has_the_mean_and_the_spread(finished):
    (axes,) = curves(finished).axes
    lines = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert lines == {
        "learner.gamma=0.5": [[64, 8.0], [128, 3.5]],
        "learner.gamma=0.9": [[64, 7.0], [128, 7.0]],
    }
    (band, _) = axes.collections
    vertices = {tuple(vertex) for vertex in band.get_paths()[0].vertices}
    assert {(64.0, 7.0), (64.0, 9.0), (128.0, 2.0), (128.0, 5.0)} <= vertices


def test_an_unfinished_member_is_named(finished):
    (finished.runs[2].path / "evaluation.json").unlink()
    with pytest.raises(RunError, match=re.escape(f"{finished.runs[2].path}: got no evaluation.json")):
        report(finished)
