"""The benchmark of a GPU: a training's times, a row for each point."""

import json

import pytest

from benchmarks.__main__ import main
from benchmarks.harness import common
from benchmarks.speed import gpu


def test_the_clock_of_a_training_runs_in_its_epochs():
    rows = [
        {"env_steps": 100, "speed/env_steps_per_s": 50.0},
        {"env_steps": 200, "speed/env_steps_per_s": 100.0, "evaluation/median_mm": 4.0},
        {"env_steps": 300, "speed/env_steps_per_s": 100.0, "evaluation/median_mm": 1.5},
    ]
    assert gpu.times_to(rows) == {"trained_s": 4.0, "to_5_mm_s": 3.0, "to_2_mm_s": 4.0, "to_1_mm_s": None}


@pytest.mark.slow
def test_smoke(tmp_path, monkeypatch):
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    monkeypatch.setattr(gpu, "split_cpu", lambda: None)  # JAX has been used: no more devices
    monkeypatch.setattr(gpu, "STEPS", {("chain", "quasistatic"): (8,)})
    tiny = ("--learner.n-arms", "16", "--learner.total-env-steps", "1024", "--env.n-poses", "256")
    monkeypatch.setattr(gpu, "TRAININGS", {"analytic": ("0,1", tiny)})
    assert main(["gpu", "--keep", str(tmp_path / "runs")]) == 0
    figures = json.loads((tmp_path / "gpu.json").read_text("utf-8"))["figures"]
    assert figures["env_steps"][0]["env_steps_per_s"] > 0
    assert [(row["seed"], row["trained_s"] > 0) for row in figures["trainings"]] == [(0, True), (1, True)]
