"""The loop of a run: what it prints, and arms that diverge."""

import dataclasses

import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm.env import EnvConfig
from tests.train.small import CONFIG
from train.runs import run


def test_success_is_of_episodes_or_of_single_actions():
    episodes = {"env/episodes": 8.0, "env/successes": 6.0}
    for row, text in ((episodes, "exploring: success 75 % of episodes"), ({}, "success 50 % of actions")):
        assert run._success([row | {"env/reached": 0.5}] * 2) == text


def test_an_epoch_in_which_most_arms_in_motion_diverge_ends_the_run_and_names_the_step():
    moving = dataclasses.replace(CONFIG, env=EnvConfig(mode="dynamic", simulation_step_s=0.02))
    run.refuse_divergence(moving, 8.0)
    run.refuse_divergence(CONFIG, 16.0)  # at rest
    message = rf"env\.simulation_step_s: got 0\.02, with which 9 of {moving.learner.n_env_steps(1)}"
    with pytest.raises(InputError, match=message):
        run.refuse_divergence(moving, 9.0)
