"""Stages run once, in their order, elsewhere, and those that fail are named."""

import pytest

from benchmarks.harness.stages import WorkStage, claim, run_stages
from mjx_softarm._support.errors import InputError


def leave(folder, settings, *names):
    """Leave results, and a line for each call."""
    for name in names:
        (folder / name).touch()
    with (folder / "calls.txt").open("a") as file:
        file.write(f"{' '.join(names)}\n")


def fail(folder, settings):
    raise ValueError("not today")


def test_stages_run_elsewhere_group_by_group_and_only_where_a_result_is_missing(tmp_path):
    groups = [
        [WorkStage("first", ("a",), leave, ("a",))],
        [WorkStage("second", ("b", "c"), leave, ("b", "c"))],
    ]
    run_stages(tmp_path, None, groups)
    (tmp_path / "c").unlink()  # one of two results
    run_stages(tmp_path, None, groups)
    assert (tmp_path / "calls.txt").read_text().splitlines() == ["a", "b c", "b c"]
    with pytest.raises(InputError, match="bad: ValueError: not today"):
        run_stages(tmp_path, None, [[WorkStage("bad", ("d",), fail)]])
    with pytest.raises(InputError, match="empty: InputError: got no e in .*, expected its results"):
        run_stages(tmp_path, None, [[WorkStage("empty", ("e",), leave, ("f",))]])


def test_a_folder_of_other_settings_is_refused(tmp_path):
    claim(tmp_path, {"n_points": 3, "names": ("a",)})
    claim(tmp_path, {"n_points": 3, "names": ("a",)})
    with pytest.raises(InputError, match=r"settings.json: got n_points 3, expected n_points 40;"):
        claim(tmp_path, {"n_points": 40, "names": ("a",)})
