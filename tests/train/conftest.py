"""Learning from demonstrations on a short arm, which compiles in seconds."""

import numpy as np
import pytest

from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.spec import ArmSpec
from train.agent.gail import GailConfig
from train.agent.hindsight import HindsightConfig
from train.agent.tqc import TQCConfig
from train.config import ImitationConfig, Stage
from train.demos.demonstrations import Demonstrations

N_POSITIONS = 6


@pytest.fixture(scope="session")
def imitation_config():
    """Eight epochs of two stages; goals are rebalanced after every third epoch."""
    return ImitationConfig(
        n_arms=8,
        total_env_steps=128,
        updates_per_env_step=0.5,
        warmup_env_steps=16,
        batch_size=16,
        replay_capacity=64,
        vector_steps_per_epoch=2,
        env=EnvConfig(n_poses=256),
        tqc=TQCConfig(hidden_actor=(16, 16), hidden_critic=(16, 16), learning_rate_end=0.1),
        hindsight=HindsightConfig(0.0, 0.0),
        gail=GailConfig(hidden=(16,)),
        stages=(Stage(share=0.5, every=2), Stage(share=0.5, kept=0.25)),
        rebalance_env_steps=48,
    )


@pytest.fixture(scope="session")
def short_env(imitation_config):
    """One section of two links."""
    spec = ArmSpec.default().replace(structure={"n_sections": 1, "links_per_section": 2})
    return ReachEnv(spec, imitation_config.env)


@pytest.fixture(scope="session")
def shown(short_env):
    """Six demonstrated positions."""
    pool = short_env.pool
    positions, actions = pool.pose[:N_POSITIONS], short_env.action_of(pool.spring_m[:N_POSITIONS])
    return Demonstrations(positions, actions, np.zeros(N_POSITIONS, np.int32))
