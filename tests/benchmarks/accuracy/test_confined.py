"""Runs of the confined pipes: displaced objects, and the options that trainings get."""

import numpy as np
import pytest

from benchmarks.accuracy import confined
from benchmarks.paper.engine import Settings
from mjx_softarm._support import cli
from mjx_softarm.mechanics.pipe import PIPES
from train.__main__ import COMMANDS


def test_displaced_objects_lie_aside_or_nearer_to_the_crossing():
    goals = np.zeros((4, 6))
    goals[:, 0] = [210.0, -210.0, 0.0, 210.0]
    names = ["pick right", "pick left", "pick bottom", "place right"]
    moved = np.concatenate([confined.displaced(goals, names, seed) for seed in range(20)])
    moved = moved.reshape(20, 4, 6) - goals
    np.testing.assert_allclose(np.linalg.norm(moved[:, :3], axis=-1), confined.OFF_MM)
    assert (moved[:, 0, 0] <= 0).all() and (moved[:, 1, 0] >= 0).all() and (moved[:, 3] == 0).all()
    assert (moved[..., 2:] == 0).all() and np.ptp(moved[:, 2, 0]) > 40.0


@pytest.mark.parametrize("case", confined.CASES)
def test_a_training_has_the_walls_of_its_pipe(tmp_path, monkeypatch, case):
    given = []
    monkeypatch.setattr(confined, "command", lambda log, *words: given.extend(words))
    confined.train(tmp_path, Settings(), case, 1, 2, 8192)
    options = cli.read("train", COMMANDS, given)[1]
    config, (hand_made, learned) = options.config, ("hand-made" in case, "hand-made" not in case)
    assert config.env.pipe_contact and config.env.pipe == PIPES[confined.CASES[case].task]
    assert (config.learner.hand_made_weight > 0) == (hand_made or "both" in case)
    assert (config.learner.learned_weight > 0) == learned
    assert (config.env.clearance_cost_per_mm > 0) == ("clearance" in case)
    taken = tmp_path / "lips-learned-twin1-seed2" if "narrow" in case else None
    assert options.reward == taken and config.learner.total_env_steps == 8192


def test_a_case_that_was_not_run_misses_no_target():
    row = {"case": "lips-learned", "objects": "as shown", "done": 4, "wall_max_n": 4.9}
    learned, narrow = confined.targets([row, row | {"wall_max_n": 5.1}])
    assert (learned["measured"], learned["verdict"]) == ("1 of 2", "NOT MET")
    assert (narrow["measured"], narrow["verdict"]) == ("not run", "skipped")
