"""Environments: one arm that reaches for poses, many arms at once, and both for Gymnasium."""

from mjx_softarm.env.config import EnvConfig, Randomisation
from mjx_softarm.env.reach import ArmState, ReachEnv

__all__ = ["ArmState", "EnvConfig", "Randomisation", "ReachEnv"]
