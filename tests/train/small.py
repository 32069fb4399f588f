"""A short arm and a short run, which compile in seconds."""

from mjx_softarm.env import EnvConfig
from tests.arms import SHORT as SHORT
from train.agent.tqc import TQCConfig
from train.config import TrainConfig
from train.epoch.job import Job

SETTINGS = {
    "n_arms": 8,
    "total_env_steps": 128,
    "updates_per_env_step": 0.5,
    "warmup_env_steps": 16,
    "batch_size": 16,
    "replay_capacity": 64,
    "vector_steps_per_epoch": 2,
}
LEARNER = TQCConfig(**SETTINGS, hidden=(16, 16), hidden_critic=(16, 16), learning_rate_end=0.1)
CONFIG = TrainConfig(learner=LEARNER, env=EnvConfig(engine="chain", n_poses=256))  # compiles in seconds


def new_job(config, env):
    return Job(config.learner.make_epoch(env))


def flags(**changes):
    """Options of a command that trains this short run for 16 epochs; changes are settings of the learner."""
    short = {"hidden": 16, "hidden_critic": 16, "total_env_steps": 256, "updates_per_env_step": 1}
    learner = {**SETTINGS, **short, "replay_capacity": 128, **changes}
    options = (f"--learner.{name}={value}" for name, value in learner.items())
    return ["--engine=chain", "--env.n-poses=256", *options]
