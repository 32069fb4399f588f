"""A short arm and a short run, which compile in seconds."""

from mjx_softarm.env import EnvConfig
from mjx_softarm.spec import ArmSpec
from train.agent.hindsight_tqc import HindsightTQC
from train.agent.tqc import TQCConfig
from train.config import TrainConfig
from train.epoch.job import Job

SHORT = ArmSpec.default().replace(structure={"n_sections": 1, "links_per_section": 2})
SETTINGS = {
    "n_arms": 8,
    "total_env_steps": 128,
    "updates_per_env_step": 0.5,
    "warmup_env_steps": 16,
    "batch_size": 16,
    "replay_capacity": 64,
    "vector_steps_per_epoch": 2,
}
CONFIG = TrainConfig(
    **SETTINGS,
    env=EnvConfig(n_poses=256),
    tqc=TQCConfig(hidden_actor=(16, 16), hidden_critic=(16, 16), learning_rate_end=0.1),
)


def new_job(config, env, **more):
    return Job(config, env, HindsightTQC(config, env), **more)


def flags(**changes):
    """Options of a command that trains this short run for 16 epochs, with changes."""
    networks = {"env.n_poses": 256, "tqc.hidden_actor": 16, "tqc.hidden_critic": 16}
    short = {
        "total_env_steps": 256,
        "updates_per_env_step": 1,
        "replay_capacity": 128,
        "evaluation_epochs": 4,
    }
    return [f"--{name}={value}" for name, value in {**SETTINGS, **networks, **short, **changes}.items()]
