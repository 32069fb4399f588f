"""brax's wrappers and brax's own agent on the environment, as they are."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import training
from brax.training.agents.sac import networks, train

from mjx_softarm.env import EnvConfig, ReachEnv
from tests.train.small import SHORT

N_ARMS, EPISODE_LENGTH, N_STEPS = 8, 2, 96


pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(scope="module")
def env():
    return ReachEnv(SHORT, EnvConfig(n_poses=64))


def test_brax_s_wrappers_keep_the_state_s_types(env):
    wrapped = training.EvalWrapper(training.wrap(env, episode_length=EPISODE_LENGTH))
    keys = jax.random.split(jax.random.PRNGKey(0), N_ARMS)  # brax's keys are of the old kind
    before = jax.eval_shape(wrapped.reset, keys)
    after = jax.eval_shape(wrapped.step, before, jnp.zeros((N_ARMS, env.action_size)))
    assert after.obs.shape == (N_ARMS, env.observation_size)
    described = [jax.tree.map(lambda x: (x.shape, x.dtype), state) for state in (before, after)]
    assert described[0] == described[1]


def test_brax_s_sac_trains(env):
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        if not hasattr(jax, "device_put_replicated"):
            pytest.skip(f"brax's agents call jax.device_put_replicated, which jax {jax.__version__} has not")
    make_policy, params, metrics = train.train(
        env,
        num_timesteps=N_STEPS,
        episode_length=EPISODE_LENGTH,
        num_envs=N_ARMS,
        num_eval_envs=N_ARMS,
        batch_size=16,
        max_replay_size=N_STEPS,
        learning_rate=1e-2,
        network_factory=functools.partial(networks.make_sac_networks, hidden_layer_sizes=(8,)),
        seed=3,
        max_devices_per_host=1,
    )
    # Every action is stored, and the size is reported as its mean over the run.
    assert metrics["training/buffer_current_size"] == np.arange(N_ARMS, N_STEPS + 1, N_ARMS).mean()
    losses = [metrics[f"training/{name}_loss"] for name in ("critic", "actor", "alpha")]
    assert np.isfinite(losses).all() and metrics["training/critic_loss"] > 0
    assert metrics["training/alpha"] != 1.0  # where it starts
    assert metrics["eval/avg_episode_length"] == EPISODE_LENGTH and metrics["eval/episode_unsettled"] == 0
    # An episode of two actions: each earns 100, -100, or the cost of an error.
    assert -200.0 <= metrics["eval/episode_reward"] <= 200.0

    assert all(np.isfinite(x).all() for x in jax.tree.leaves(params))
    action, _ = make_policy(params, deterministic=True)(jnp.zeros((1, 18)), jax.random.PRNGKey(0))
    assert action.shape == (1, 3) and float(jnp.abs(action).max()) <= 1.0
