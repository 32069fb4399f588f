"""Clearance of the body on the way of an action in motion."""

import dataclasses

import jax
import numpy as np

from mjx_softarm._support import xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.pipe import CrossPipe, body_clearance
from tests.arms import SHORT

MM = 1e-3


def test_in_motion_the_clearance_is_the_least_of_the_way(quick_compiler):
    """That of an action of six control periods against six actions of one, and the arm in the end."""
    config = EnvConfig(n_poses=64, mode="dynamic", pipe_diameter_mm=300.0)
    long, short = (
        ReachEnv(SHORT, dataclasses.replace(config, dynamic_step_s=step_s)) for step_s in (0.12, 0.02)
    )
    keys = jax.random.split(jax.random.PRNGKey(0), 16)
    actions = jax.random.uniform(jax.random.PRNGKey(1), (16, long.action_size), minval=-1.0, maxval=1.0)
    start = xla.jit(jax.vmap(long.reset))(keys)
    end = xla.jit(jax.vmap(long.step))(start, actions)
    now = start.replace(info=xla.jit(jax.vmap(short.reset))(keys).info)
    step = xla.jit(jax.vmap(short.step))
    way = [(now := step(now, actions)).info["clearance_mm"] for _ in range(6)]
    np.testing.assert_allclose(end.pipeline_state.pose, now.pipeline_state.pose, atol=0.01)
    least_mm = np.min(way, axis=0)
    np.testing.assert_allclose(end.info["clearance_mm"], least_mm, atol=0.01)
    assert (least_mm < way[-1] - 0.1).any() and (least_mm == way[-1]).any()
    # Against kinematics in closed form
    frames = jax.vmap(chain_kinematics(ArmParams.from_spec(SHORT)))(end.pipeline_state.motion.q)
    plates = frames.plate_position, frames.plate_rotation
    wall_m = body_clearance(CrossPipe(300.0), *plates, SHORT)
    np.testing.assert_allclose(way[-1], wall_m / MM, atol=0.02)
