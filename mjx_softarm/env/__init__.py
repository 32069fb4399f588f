"""Environments: one arm that reaches for poses, many arms at once, and both for Gymnasium."""

from mjx_softarm.env.reach import ArmState, EnvConfig, Lot, Randomisation, ReachEnv

__all__ = ["ArmState", "EnvConfig", "Lot", "Randomisation", "ReachEnv"]
