"""Arms whose actions are pressures, and payloads that policies observe."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.paper.independence import POLICIES, PressureEnv, follow
from mjx_softarm._support import xla
from mjx_softarm.env import EnvConfig, Randomisation
from mjx_softarm.mdp import rewards
from tests.train.small import SHORT
from train.agent.analytic import GradientEpoch
from train.config import override
from train.presets import PRESETS


@pytest.fixture(scope="module")
def arms(quick_compiler):
    """An environment, two arms, and a function: arms, actions (2, 3) -> next arms, gradients of z."""
    env = PressureEnv(SHORT, EnvConfig(n_poses=16))
    start = xla.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2))

    def height(action, state):
        after = env.step(state, action)
        return after.pipeline_state.pose[2], after

    both = xla.jit(jax.vmap(jax.value_and_grad(height, has_aux=True)))

    def step(state, action):
        (_, after), slope = both(action, state)
        return after, slope

    return SimpleNamespace(env=env, start=start, step=step)


def test_an_action_is_a_pressure_whatever_the_payload(arms):
    action, chambers = jnp.array([[-1.0, 0.0, 0.5], [0.2, 0.2, 0.2]]), SHORT.chambers
    arm = arms.start.pipeline_state
    heavy = arms.start.replace(pipeline_state=arm._replace(payload_kg=arm.payload_kg + 0.5))
    (free, _), (loaded, _) = arms.step(arms.start, action), arms.step(heavy, action)
    low, high = chambers.pressure_min_kpa, chambers.pressure_max_kpa
    for after in (free, loaded):
        asked = low + 0.5 * (action + 1.0) * (high - low)
        np.testing.assert_allclose(after.pipeline_state.pressure_kpa, asked, atol=0.02)
        assert after.info["valid"].all() and not after.info["blocked"].any()
    sunk_mm = free.pipeline_state.pose[:, 2] - loaded.pipeline_state.pose[:, 2]
    assert (sunk_mm > 1.0).all()


def test_pressures_cost_the_error_of_the_pose_alone(arms):
    config = override(PRESETS["analytic"], POLICIES["pressures"].settings)
    action = jnp.array([-0.9, 0.0, 0.5])
    after = jax.tree.map(lambda x: x[0], arms.step(arms.start, jnp.stack([action, action]))[0])
    arm, reward = after.pipeline_state, arms.env.config.reward
    error = rewards.scaled_error(arm.pose, arm.goal, reward)
    cost = GradientEpoch(config.learner, arms.env)._cost(action, after)
    np.testing.assert_allclose(cost, jnp.linalg.norm(error) / reward.threshold, rtol=1e-5)


def test_the_pose_has_a_gradient_by_the_pressures(arms):
    more = 1e-2 * jnp.ones((2, 3))
    ahead, behind = (arms.step(arms.start, sign * more)[0].pipeline_state.pose[:, 2] for sign in (1, -1))
    _, slope = arms.step(arms.start, 0.0 * more)
    assert (np.abs(ahead - behind) > 0.05).all()
    np.testing.assert_allclose(jnp.sum(slope * 2.0 * more, axis=1), ahead - behind, rtol=0.02)


def test_a_payload_is_carried_and_observed_from_the_first_action_on(quick_compiler):
    config = EnvConfig(n_poses=16, observation="payload", randomisation=Randomisation(payload_max_kg=1.0))
    env, chambers = PressureEnv(SHORT, config), SHORT.chambers
    as_heavy = SimpleNamespace(mode=lambda policy, obs: jnp.full(3, obs[-1]))
    path, low, high = env.pool.pose[:2], chambers.pressure_min_kpa, chambers.pressure_max_kpa
    one = xla.jit(lambda load_kg: follow(env, as_heavy, None, load_kg, path, jax.random.key(0)))
    light, heavy = one(0.25), one(0.75)
    for reached, load_kg in ((light, 0.25), (heavy, 0.75)):
        np.testing.assert_allclose(
            reached.pressure_kpa, low + 0.5 * (load_kg + 1.0) * (high - low), atol=0.02
        )
    assert not np.allclose(light.pose, heavy.pose, atol=1.0)
