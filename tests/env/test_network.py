"""The environment with a sim-to-real network: what it shows is the real arm, what it simulates is not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm._support import xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.pipe import CrossPipe, body_clearance
from mjx_softarm.sensing.pose import frame_from_pose
from tests.arms import SHORT
from tests.networks import s2r_of

MM = 1e-3


def test_with_a_network_every_pose_is_the_real_one_and_the_arm_underneath_the_same():
    """A network that looks at a spring: poses of reset, step, pool and reward are corrected, and the body."""
    config = EnvConfig(engine="chain", n_poses=64, pipe_diameter_mm=300.0)
    n_springs = SHORT.n_chambers
    weight = np.zeros((9 + n_springs, 6), np.float32)
    weight[9, 0] = 30.0  # mm for half the range of the first spring
    bias, bound = np.float32([0.0, -4.0, 0.0, 0.0, 0.0, 0.1]), np.float32([40.0] * 3 + [0.2] * 3)
    inputs = {
        "input_low": np.float32([-0.5] * 3 + [-1.0] * 6 + [0.05] * n_springs),
        "input_high": np.float32([0.5] * 3 + [1.0] * 6 + [0.35] * n_springs),
    }
    network = s2r_of(((weight, bias),), bound, **inputs)
    plain, real = ReachEnv(SHORT, config), ReachEnv(SHORT, config, network)
    with pytest.raises(ValueError, match="got 3, expected 2, as the sim-to-real network has"):
        ReachEnv(SHORT, dataclasses.replace(config, links_per_section=3), network)
    keys = jax.random.split(jax.random.PRNGKey(0), 16)
    actions = jax.random.uniform(jax.random.PRNGKey(1), (16, n_springs), minval=-0.5, maxval=0.5)
    starts = [xla.jit(jax.vmap(e.reset))(keys) for e in (plain, real)]
    ends = [xla.jit(jax.vmap(e.step))(s, actions) for e, s in zip((plain, real), starts, strict=True)]
    assert ends[0].info["valid"].all()
    for one, other in (starts, ends):
        arm, seen = one.pipeline_state, other.pipeline_state
        for name in ("spring_m", "pressure_kpa"):
            np.testing.assert_allclose(getattr(seen, name), getattr(arm, name), rtol=1e-5, atol=1e-6)
        shift_mm = 30.0 * (arm.spring_m[:, 0] - 0.2) / 0.15  # of the true lengths, not the noisy readings
        np.testing.assert_allclose(seen.pose[:, 0] - arm.pose[:, 0], shift_mm, atol=0.01)
        np.testing.assert_allclose(seen.pose[:, 1] - arm.pose[:, 1], -4.0, atol=0.01)
        assert np.abs(seen.pose[:, 3:] - arm.pose[:, 3:]).max() > 1.0
        np.testing.assert_allclose(other.obs, real.observe(seen.pose, seen.goal), atol=1e-5)
        frames = jax.vmap(chain_kinematics(ArmParams.from_spec(SHORT)))(arm.motion.q)
        share = jnp.array([0.0, 0.5, 1.0])[:, None]  # base, between the two links, tip
        plates_m = frames.plate_position + share * MM * (seen.pose - arm.pose)[:, None, :3]
        rotation = frames.plate_rotation.at[:, -1].set(frame_from_pose(seen.pose)[1])
        wall_m = body_clearance(CrossPipe(300.0), plates_m, rotation, SHORT)
        np.testing.assert_allclose(other.info["clearance_mm"], wall_m / MM, atol=0.02)
        assert np.abs(other.info["clearance_mm"] - one.info["clearance_mm"]).max() > 1.0
    np.testing.assert_allclose(real.pool.pose[:, 1] - plain.pool.pose[:, 1], -4.0, atol=0.01)
    goal = ends[1].pipeline_state.goal
    assert np.isin(goal[:, 0], real.pool.pose[:, 0]).all()
    tip_mm = np.linalg.norm(ends[1].pipeline_state.pose[:, :3] - goal[:, :3], axis=1)
    np.testing.assert_allclose(ends[1].metrics["tip_error_mm"], tip_mm, rtol=1e-4)
