"""Stages run once, in their order, elsewhere; commands that fail are named; trainings resume."""

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
        [WorkStage(("a",), leave, ("a",))],
        [WorkStage(("b", "c"), leave, ("b", "c"))],
    ]
    run_stages(tmp_path, None, groups)
    (tmp_path / "c").unlink()  # one of two results
    run_stages(tmp_path, None, groups)
    assert (tmp_path / "calls.txt").read_text().splitlines() == ["a", "b c", "b c"]
    with pytest.raises(InputError, match="d: ValueError: not today"):
        run_stages(tmp_path, None, [[WorkStage(("d",), fail)]])
    with pytest.raises(InputError, match="e: InputError: got no e in .*, expected its results"):
        run_stages(tmp_path, None, [[WorkStage(("e",), leave, ("f",))]])


def test_a_folder_of_other_settings_is_refused(tmp_path):
    claim(tmp_path, {"n_points": 3, "names": ("a",)})
    claim(tmp_path, {"n_points": 3, "names": ("a",)})
    with pytest.raises(InputError, match=r"settings.json: got n_points 3, expected n_points 40;"):
        claim(tmp_path, {"n_points": 40, "names": ("a",)})


PROGRAM = """
import pathlib, sys
print("its last words")
pathlib.Path(sys.argv[1]).touch()
sys.exit(int(sys.argv[2]))
"""


def test_a_command_with_results_goes_on_and_another_is_named(tmp_path, monkeypatch):
    """Status 1 says that a bound is missed, or that Python ended with a traceback."""
    (tmp_path / "measuring.py").write_text(PROGRAM)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    log, made = tmp_path / "calib.log", tmp_path / "report.json"
    for status in (0, 1):
        command(log, "measuring", made, status, makes=made)
    for status, makes in ((1, tmp_path / "absent"), (3, made)):
        message = rf"(?s)python -m measuring .* {status}: got exit status {status}, .*\nits last words"
        with pytest.raises(InputError, match=message):
            command(log, "measuring", made, status, makes=makes)


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
