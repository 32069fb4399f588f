"""A made-up policy."""

import numpy as np

from mjx_softarm import ArmSpec
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.policy.file import policy_from_actor

SPEC = ArmSpec.default()
N = SPEC.n_chambers


def make_policy(make_arm_model, spec=SPEC, s2r=False):
    """A policy whose actor always asks for the middle of its range, and that accepts every goal."""
    dense = {"head": {"kernel": np.zeros((18, 2 * N)), "bias": np.zeros(2 * N)}}
    everywhere = np.float32(np.random.default_rng(0).uniform(-1e4, 1e4, (50, 6)))
    model = make_arm_model(spec, s2r)._replace(workspace=everywhere)
    return policy_from_actor({"params": dense}, spec, RewardConfig(), model, {})
