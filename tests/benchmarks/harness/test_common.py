"""Spreads over runs, tables of figures, and targets."""

import json

import pytest

from benchmarks import __main__ as benchmarks
from benchmarks.harness import common
from benchmarks.harness.common import over_runs, spread, target


def test_spreads_are_those_of_the_runs_of_a_group():
    rows = [{"way": w, "mm": mm, "n": 4} for w, mm in (("a", 1.0), ("b", 5.0), ("a", 2.0))]
    assert over_runs(rows, ("way",), ("mm", "n", "absent")) == [
        {"way": "a", "runs": 2, "mm": "1.5 ± 0.5 (1 to 2)", "n": "4"},
        {"way": "b", "runs": 1, "mm": "5", "n": "4"},
    ]
    assert spread([1.0, float("nan")]) == "nan ± nan (nan to nan)"  # a missed goal is not hidden


@pytest.mark.parametrize(
    ("met", "more", "status"),
    [(True, {}, 0), (None, {}, 0), (False, {}, 1), (True, {"failed": [{"contestant": "sbx [no GPU]"}]}, 1)],
)
def test_a_missed_target_or_a_failure_ends_with_status_1_and_its_file_is_there(
    met, more, status, monkeypatch, tmp_path
):
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    targets = [target("1 mm", "0.5 mm", True), target("less", "2 mm", met)]
    figures = {"mm": 2.0, "arms": 1024, "targets": targets} | more
    assert benchmarks._finish("settle", figures) == status
    assert json.loads((tmp_path / "settle.json").read_text())["figures"] == figures
