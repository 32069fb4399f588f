"""Learning from demonstrations on a short arm, which compiles in seconds."""

import dataclasses

import numpy as np
import pytest

from mjx_softarm.env import ReachEnv
from tests.arms import SHORT
from tests.train.small import CONFIG, LEARNER
from train.agent.gail import GailConfig
from train.agent.hindsight import HindsightConfig
from train.agent.imitation import GoalStage, ImitationConfig
from train.config import TrainConfig
from train.demos.demonstrations import Demonstrations

N_POSITIONS = 6
# A base and a tip that are mounted askew, as on every calibrated arm.
MOUNTED = SHORT.replace(
    mounting={
        "tip_offset_m": (0.002, -0.006, 0.0),
        "tip_turn_deg": (1.0, -2.0, 4.0),
        "base_offset_m": (0, 0.01, 0),
    }
)


@pytest.fixture(scope="session")
def imitation_config():
    """Eight epochs of two stages; goals are rebalanced after every third epoch."""
    learner = ImitationConfig(
        **dataclasses.asdict(LEARNER) | {"hindsight": HindsightConfig(0.0, 0.0)},
        gail=GailConfig(hidden=(16,)),
        stages=(GoalStage(share=0.5, every=2), GoalStage(share=0.5, kept=0.25)),
        rebalance_env_steps=48,
    )
    return TrainConfig(learner=learner, env=CONFIG.env)


@pytest.fixture(scope="session")
def short_env(imitation_config):
    return ReachEnv(MOUNTED, imitation_config.env)


@pytest.fixture(scope="session")
def shown(short_env):
    """Six demonstrated positions."""
    pool = short_env.pool
    positions, actions = pool.pose[:N_POSITIONS], short_env.action_of(pool.spring_m[:N_POSITIONS])
    return Demonstrations(positions, actions, np.zeros(N_POSITIONS, np.int32))
