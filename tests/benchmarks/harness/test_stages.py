"""Stages run once, in their order, elsewhere; commands that fail are named; trainings resume."""

import subprocess
import sys

import pytest

from benchmarks.harness import stages
from benchmarks.harness.stages import WorkStage, claim, command, run_stages, train
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


@pytest.mark.parametrize(("status", "writes"), [(0, True), (1, True), (1, False), (-9, True)])
def test_a_command_with_results_goes_on_and_another_is_named(tmp_path, monkeypatch, status, writes):
    """Status 1 says that a bound is missed, or that Python ended with a traceback."""
    log, made = tmp_path / "calib.log", tmp_path / "report.json"

    def run(words, stdout, **_):
        assert words == [sys.executable, "-m", "calib", "run", "3"]
        stdout.write("its last words")
        if writes:
            made.touch()
        return subprocess.CompletedProcess([], status)

    monkeypatch.setattr(stages.subprocess, "run", run)
    if status in (0, 1) and writes:
        command(log, "calib", "run", 3, makes=made)
    else:
        message = (
            rf"(?s)python -m calib run 3: got exit status {status}, expected .*ends with\nits last words"
        )
        with pytest.raises(InputError, match=message):
            command(log, "calib", "run", 3, makes=made)


def test_a_training_resumes_and_without_a_checkpoint_or_a_config_starts_anew(tmp_path, monkeypatch):
    asked, run = [], tmp_path / "run"
    monkeypatch.setattr(stages, "command", lambda log, *words, makes: asked.append(words))
    for made in (("config.json",), ("checkpoints/0",), ("checkpoints/0", "config.json")):
        for name in made:
            (run / name).mkdir(parents=True)
        train(run, "reach", "--seed", 1)
        assert run.exists() == (len(made) == 2)
    new = ("train", "reach", "--seed", 1, "--out", run)
    assert asked == [new, new, ("train", "reach", "--resume", run)]
