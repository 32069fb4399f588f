"""Runs whose arms diverge."""

import dataclasses

import pytest

from mjx_softarm.env import EnvConfig
from tests.train.small import CONFIG
from train.runs.checkpoint import RunError
from train.runs.run import refuse_divergence


def test_an_epoch_in_which_most_arms_in_motion_diverge_ends_the_run_and_names_the_step():
    moving = dataclasses.replace(CONFIG, env=EnvConfig(mode="dynamic", simulation_step_s=0.02))
    refuse_divergence(moving, 8.0)
    refuse_divergence(CONFIG, 16.0)  # at rest
    told = rf"env\.simulation_step_s: got 0\.02, with which 9 of {moving.learner.n_env_steps(1)}"
    with pytest.raises(RunError, match=told):
        refuse_divergence(moving, 9.0)
