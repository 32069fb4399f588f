"""Runs whose arms diverge."""

import dataclasses

import pytest

from mjx_softarm.env import EnvConfig
from tests.train.small import CONFIG
from train.runs.checkpoint import RunError
from train.runs.run import refuse_divergence

MOVING = dataclasses.replace(CONFIG, env=EnvConfig(mode="dynamic", simulation_step_s=0.02))
N_ACTIONS = MOVING.learner.n_env_steps(1)


def test_an_epoch_in_which_most_arms_diverge_ends_the_run_and_names_the_step():
    with pytest.raises(RunError, match=rf"env\.simulation_step_s: got 0\.02, with which 9 of {N_ACTIONS}"):
        refuse_divergence(MOVING, 9.0)


@pytest.mark.parametrize("config, n_unsettled", [(MOVING, 8.0), (CONFIG, 16.0)])
def test_a_few_arms_or_arms_at_rest_do_not(config, n_unsettled):
    refuse_divergence(config, n_unsettled)
