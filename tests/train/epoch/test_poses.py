"""Pools of poses that a run draws starts and goals from."""

import dataclasses

import numpy as np
import pytest

from mjx_softarm.env import EnvConfig, ReachEnv
from tests.train.small import SHORT
from train.config import TrainConfig
from train.epoch.poses import Poses
from train.presets import PRESETS

CONFIG = TrainConfig(
    learner=dataclasses.replace(PRESETS["analytic"].learner, total_env_steps=64 * 256 * 6),
    fresh_poses_epochs=2,
    env=EnvConfig(n_poses=32, even_share=0.5),
)


@pytest.fixture(scope="module")
def env():
    return ReachEnv(SHORT, CONFIG.env)


def test_a_pool_serves_some_epochs_and_each_run_has_its_own(env):
    poses = Poses(env, CONFIG)
    pools = [np.asarray(poses.at(epoch).pose) for epoch in range(6)]
    for epoch, pool in enumerate(pools):
        assert np.array_equal(pool, pools[epoch // 2 * 2])
        assert pool.shape == env.poses.shapes.pose.shape
    every = np.concatenate([*pools[::2], Poses(env, dataclasses.replace(CONFIG, seed=1)).at(0).pose])
    assert len(np.unique(every[:, 0].round(3))) > 3 * 32  # a pool may have a pose twice


def test_a_run_that_goes_on_has_the_poses_that_it_would_have_had(env):
    poses = Poses(env, CONFIG)
    for epoch in range(5):
        last = poses.at(epoch)
    np.testing.assert_array_equal(last.q, Poses(env, CONFIG).at(4).q)


def test_without_fresh_poses_the_pool_is_the_environment_s(env):
    poses = Poses(env, dataclasses.replace(CONFIG, fresh_poses_epochs=0))
    assert poses.at(0) is poses.at(5) is env.pool
