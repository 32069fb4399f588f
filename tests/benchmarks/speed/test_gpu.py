"""The benchmark of a GPU: rows of programs that take turns, a training's times, sizes that fit."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.speed import gpu
from train.config import override
from train.presets import PRESETS


def test_each_size_has_a_row_and_a_program_that_failed_says_why(monkeypatch):
    monkeypatch.setattr(gpu, "STEPS", {("mjx", "dynamic"): (8, 64)})
    monkeypatch.setattr(gpu, "LEARNERS", {"quick": ((8, 4),)})

    def take_turns(workers, n_rounds, n_starting):
        bad, *good = workers
        rates = [{"env_steps_per_s": 1000.0 * k} for k in range(1, n_rounds + 1)]
        return {worker.name: rates for worker in good}, {bad.name: "out of memory"}

    monkeypatch.setattr(gpu, "take_turns", take_turns)
    found = gpu.speed()
    assert found["env_steps"] == [
        {"engine": "mjx", "mode": "dynamic", "arms": 8, "failed": "out of memory"},
        {"engine": "mjx", "mode": "dynamic", "arms": 64, "env_steps_per_s": 1500},
    ]
    assert found["learning"] == [{"preset": "quick", "arms": 8, "batch": 4, "env_steps_per_s": 1500}]


def test_the_clock_of_a_training_runs_in_its_epochs():
    rows = [
        {"env_steps": 100, "speed/env_steps_per_s": 50.0},
        {"env_steps": 200, "speed/env_steps_per_s": 100.0, "evaluation/median_mm": 4.0},
        {"env_steps": 300, "speed/env_steps_per_s": 100.0, "evaluation/median_mm": 1.5},
    ]
    assert gpu.times_to(rows) == {"trained_s": 4.0, "to_5_mm_s": 3.0, "to_2_mm_s": 4.0, "to_1_mm_s": None}


@pytest.mark.parametrize("preset", gpu.TRAININGS)
def test_the_sizes_of_a_training_fit_each_other(preset):
    _, options = gpu.TRAININGS[preset]
    assignments = [f"{name.replace('-', '_')}={value}" for name, value in options.items()]
    learner: Any = override(PRESETS[preset], assignments).learner
    assert learner.n_env_steps(learner.n_epochs) == learner.total_env_steps
    if preset == "motion":
        assert learner.n_updates_per_vector_step == 128
