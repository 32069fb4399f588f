"""Commands of the benchmark of arms: exit statuses that end it, and what it leaves out the next time."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.accuracy import arms
from benchmarks.accuracy.arms import run_command
from mjx_softarm._support.errors import InputError


@pytest.mark.parametrize("status", [0, 1, 2, 3, 130, -9])
def test_a_command_with_results_goes_on_and_one_that_failed_ends_the_benchmark(tmp_path, monkeypatch, status):
    asked = []
    done = subprocess.CompletedProcess([], status)
    monkeypatch.setattr(subprocess, "run", lambda command, check: asked.append(command) or done)
    told = f"python -m calib run 3: got exit status {status}, expected 0 or 1"
    with contextlib.nullcontext() if status in (0, 1) else pytest.raises(InputError, match=told):
        run_command("calib", "run", 3, makes=tmp_path)
    assert asked == [[sys.executable, "-m", "calib", "run", "3"]]


def test_a_command_that_ends_with_a_traceback_ends_the_benchmark(tmp_path):
    """Python's own exit status is then 1, as that of a command with warnings."""
    with pytest.raises(InputError, match="calib.absent: got no file .*report.json, expected its results"):
        run_command("calib.absent", makes=tmp_path / "report.json")


def test_an_interrupted_arm_goes_on_and_a_refused_goal_misses_the_target(tmp_path, monkeypatch):
    """Commands that only leave their results, the training interrupted once."""
    asked, told, accuracy = (
        [],
        [],
        {"points": 4, "measured": 4, "max_mm": 5.0, "load_estimate_g": 480.0}
        | dict.fromkeys(
            ("reached", "translation_mm", "translation_95_mm", "rotation_deg", "saturated_points"), 2.0
        ),
    )
    figures = {"Chambers": {"weak": []}}
    figures["Sim-to-real network"] = {x: {"translation_mean_mm": 1.0} for x in ("test", "test_uncorrected")}
    report = {"trustworthy": True, "parts": {title: {"figures": of} for title, of in figures.items()}}

    def leave(*words, makes, python=sys.executable):
        asked.append(words[:2] if words[0] != "train" else words[:3])
        told.append((python, *map(str, words)))
        path = Path(words[-1])
        if words[1:3] == ("reach", "--resume"):
            (path / "evaluation.json").write_text("{}")
        elif words[1] == "reach":
            path.mkdir()
            (path / "config.json").write_text("{}")
            raise KeyboardInterrupt
        elif words[1] == "record":
            path.touch()
        elif words[1] == "export":
            (path / "policy.npz").touch()
        else:
            path.mkdir()
            name, what = ("report.json", report) if words[0] == "calib" else ("accuracy.json", accuracy)
            (path / name).write_text(json.dumps(what))
        assert makes.exists()

    monkeypatch.setattr(arms, "run_command", leave)
    with pytest.raises(KeyboardInterrupt):
        arms._measure("paper", tmp_path, 300, "analytic", None, 4)
    assert [words[1] for words in asked] == ["record", "record", "run", "reach"]
    for expected in (["reach", "export", "measure", "measure"], []):
        asked.clear()
        found = arms._measure("paper", tmp_path, 300, "analytic", None, 4)
        assert [words[1] for words in asked] == expected
    with_load = arms._measure("paper", tmp_path, 300, "analytic", None, 4, (500,))
    assert asked == [("mjx_softarm.deploy", "measure")] and with_load["circle, 500 g, told [g]"] == 480.0
    python, *words = told[-1]
    assert python == sys.executable and words[words.index("--payload") + 1] == "500"
    assert words[words.index("--arm") + 1] == f"twin:rod:0@{tmp_path / 'arm.toml'}"
    monkeypatch.setattr(arms, "peer_python", lambda name: f"python of {name}")
    told.clear()
    (tmp_path / "soromox/run").mkdir(parents=True)
    (tmp_path / "soromox/run/evaluation.json").write_text("{}")  # its training is not what is tested here
    arms._measure("soromox", tmp_path / "soromox", 300, "analytic", None, 4)
    with_arm = [python for python, *words in told if "--arm" in words]
    without_arm = [python for python, *words in told if "--arm" not in words]
    assert with_arm == ["python of soromox"] * 4 and set(without_arm) == {sys.executable}
    missed = found | {"circle, measured": 3}
    far = found | {"circle, mean [mm]": 3.01}
    rows = arms.targets([found, missed, far], ["a", "b", "c"])
    assert [row["verdict"] for row in rows] == ["met", "NOT MET", "NOT MET"]
    assert rows[1]["measured"] == "0.33% in the mean, 1 of 4 goals refused"


def test_each_kind_names_its_stand_in(tmp_path, monkeypatch):
    monkeypatch.setattr(arms, "peer_python", lambda name: tmp_path / name)
    rod, soromox = arms.ARMS["sopra"], arms.ARMS["soromox"]
    assert rod.arm(Path("arm.toml")) == "twin:rod:0@arm.toml" and rod.python == sys.executable
    assert soromox.arm(Path("arm.toml")) == "benchmarks.accuracy.soromox_arm:Arm"
    assert soromox.python == tmp_path / "soromox"
