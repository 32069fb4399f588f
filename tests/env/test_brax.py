"""brax's registry, wrappers and own agent on the environment, as they are."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs
from brax.training.agents.ars import train as ars
from brax.training.agents.sac import networks, train

from mjx_softarm._support import xla
from mjx_softarm.env import EnvConfig, ReachEnv
from tests.arms import SHORT

N_ARMS, EPISODE_LENGTH, N_STEPS = 8, 2, 96
EPISODES = {"episode_length": EPISODE_LENGTH, "num_eval_envs": N_ARMS}

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(scope="module")
def env():
    return ReachEnv(SHORT, EnvConfig(n_poses=64))


def test_brax_s_wrappers_step_the_arm(env):
    """brax finds the environment, and its wrappers step it, count its episodes and begin new ones."""
    assert isinstance(env, envs.Env) and env.backend == "mjx"
    config = {"spec": SHORT, "config": env.config}
    wrapped = envs.create("soft_arm", episode_length=EPISODE_LENGTH, batch_size=N_ARMS, **config)
    step = xla.jit(wrapped.step)
    first = state = xla.jit(wrapped.reset)(jax.random.PRNGKey(0))  # brax's keys are of the old kind
    for _ in range(EPISODE_LENGTH):
        state = step(state, jnp.zeros((N_ARMS, env.action_size)))
    assert isinstance(state, envs.State) and state.obs.shape == (N_ARMS, env.observation_size)
    assert jax.tree.map(jnp.shape, first) == jax.tree.map(jnp.shape, state)
    # All went to the middle of their springs' range, so all poses are one, and each episode is over: brax has
    # put the first state in the place of the last one, whose reward stays.
    np.testing.assert_array_equal(state.done, 1.0)
    np.testing.assert_array_equal(state.obs, first.obs)
    assert (np.asarray(state.metrics["tip_error_mm"]) > 0).all() and (np.asarray(state.reward) != 0).all()


def test_brax_s_ars_trains():
    """Augmented random search on the closed form: brax compiles MJX for minutes on a CPU."""
    env = ReachEnv(SHORT, EnvConfig(engine="chain", n_poses=64))
    directions = {"number_of_directions": 4, "top_directions": 2}
    make_policy, params, metrics = ars.train(env, num_timesteps=64, seed=1, **EPISODES, **directions)
    assert metrics["eval/avg_episode_length"] == EPISODE_LENGTH and metrics["eval/episode_unsettled"] == 0
    assert metrics["training/params_norm"] > 0.0  # it begins at zero
    action, _ = make_policy(params)(jnp.zeros(env.observation_size), jax.random.PRNGKey(0))
    assert action.shape == (3,) and np.isfinite(action).all()


def test_brax_s_sac_trains(env):
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        if not hasattr(jax, "device_put_replicated"):
            pytest.skip(f"brax's agents call jax.device_put_replicated, which jax {jax.__version__} has not")
    network = functools.partial(networks.make_sac_networks, hidden_layer_sizes=(8,))
    sizes = {"num_timesteps": N_STEPS, "max_replay_size": N_STEPS, "num_envs": N_ARMS, "batch_size": 16}
    others = {"learning_rate": 1e-2, "network_factory": network, "seed": 3, "max_devices_per_host": 1}
    make_policy, params, metrics = train.train(env, **EPISODES, **sizes, **others)
    # Every action is stored, and the size is reported as its mean over the run.
    assert metrics["training/buffer_current_size"] == np.arange(N_ARMS, N_STEPS + 1, N_ARMS).mean()
    assert metrics["training/critic_loss"] > 0 and metrics["training/alpha"] != 1.0  # where it starts
    assert metrics["eval/avg_episode_length"] == EPISODE_LENGTH and metrics["eval/episode_unsettled"] == 0
    # An episode of two actions: each earns 100, -100, or the cost of an error.
    assert -200.0 <= metrics["eval/episode_reward"] <= 200.0
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((metrics, params)))
    action, _ = make_policy(params, deterministic=True)(jnp.zeros((1, 18)), jax.random.PRNGKey(0))
    assert action.shape == (1, 3) and float(jnp.abs(action).max()) <= 1.0
