"""The newest policy of a run, restored without its arms."""

import dataclasses

import jax
import numpy as np

from mjx_softarm.env import ReachEnv
from tests.train.small import CONFIG, SHORT
from train.runs.checkpoint import Run
from train.runs.run import restore_policy
from train.runs.task import task_of


def test_the_policy_of_a_run_in_motion_is_restored(tmp_path):
    env = dataclasses.replace(CONFIG.env, mode="dynamic", dynamic_step_s=0.04)
    config = dataclasses.replace(CONFIG, env=env)
    task = task_of(config, ReachEnv(SHORT, env))
    run = Run.create(tmp_path / "run", config, SHORT)
    state = task.job.init(jax.random.PRNGKey(0))
    run.save(1, state)
    _, policy = restore_policy(Run.open(run.path), task)
    jax.tree.map(np.testing.assert_array_equal, policy, jax.device_get(task.job.policy(state)))
