"""Tables of figures, and targets."""

import io
import json

import pytest
from rich.console import Console

from benchmarks import __main__ as benchmarks
from benchmarks.harness import common
from benchmarks.harness.common import show, target


def shown(figures, title=""):
    console = Console(file=io.StringIO(), width=200)
    show(figures, title, console)
    return console.file.getvalue()


def cells(text):
    return [
        [cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line
    ]


def test_a_list_of_rows_is_a_table_with_a_column_for_every_name_in_any_row():
    text = shown(
        {"rates": [{"arms": 1024, "env_steps_per_s": 0.5}, {"arms": 1, "skipped": "no [cuda] here"}]}
    )
    assert ["rates"] in [line.split(",") for line in text.splitlines()]
    assert ["1,024", "0.5", ""] in cells(text)
    assert f"│ {'0.5':>15} │" in text  # numbers to the right, gaps or not
    assert ["1", "", "no [cuda] here"] in cells(text)


@pytest.mark.parametrize(("met", "status"), [(True, 0), (None, 0), (False, 1)])
def test_a_missed_target_ends_with_status_1_and_its_file_is_there(met, status, monkeypatch, tmp_path):
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    figures = {"mm": 2.0, "targets": [target("1 mm", "0.5 mm", True), target("less", "2 mm", met)]}
    assert benchmarks._finish("settle", figures) == status
    assert json.loads((tmp_path / "settle.json").read_text())["figures"] == figures
