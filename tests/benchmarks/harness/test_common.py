"""Spreads over runs, tables of figures, and targets."""

import io
import json

import pytest
from rich.console import Console

from benchmarks import __main__ as benchmarks
from benchmarks.harness import common
from benchmarks.harness.common import over_runs, show, spread, target


def test_spreads_are_those_of_the_runs_of_a_group():
    rows = [{"way": w, "mm": mm, "n": 4} for w, mm in (("a", 1.0), ("b", 5.0), ("a", 2.0))]
    assert over_runs(rows, ("way",), ("mm", "n", "absent")) == [
        {"way": "a", "runs": 2, "mm": "1.5 ± 0.5 (1 to 2)", "n": "4"},
        {"way": "b", "runs": 1, "mm": "5", "n": "4"},
    ]
    assert spread([1.0, float("nan")]) == "nan ± nan (nan to nan)"  # a missed goal is not hidden


def test_rows_become_a_table_with_a_column_for_every_name_in_any_row():
    console = Console(file=io.StringIO(), width=200)
    rates = [{"arms": 1024, "env_steps_per_s": 0.5}, {"arms": 1, "skipped": "no [cuda] here"}]
    show({"machine": "Abacus", "inner": {"rates": rates}}, "speed", console)
    text = console.file.getvalue()
    assert text.splitlines()[0] == "speed, machine: Abacus" and "\nspeed, inner, rates\n" in text
    cells = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines()]
    assert ["1,024", "0.5", ""] in cells and ["1", "", "no [cuda] here"] in cells


@pytest.mark.parametrize(("met", "status"), [(True, 0), (None, 0), (False, 1)])
def test_a_missed_target_ends_with_status_1_and_its_file_is_there(met, status, monkeypatch, tmp_path):
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    figures = {"mm": 2.0, "targets": [target("1 mm", "0.5 mm", True), target("less", "2 mm", met)]}
    assert benchmarks._finish("settle", figures) == status
    assert json.loads((tmp_path / "settle.json").read_text())["figures"] == figures


def test_a_missed_target_and_a_failure_are_told_by_the_exit_status():
    met, missed = ({"targets": [common.target("a", "1", holds)]} for holds in (True, False))
    statuses = [common.status_of(one) for one in (met, missed, met | {"failed": [{"contestant": "sbx"}]})]
    assert statuses == [0, 1, 1]
