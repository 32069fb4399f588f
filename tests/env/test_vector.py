"""Ends and new beginnings of episodes, on arms that do as they are told."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.env.state import State
from mjx_softarm.env.vector import VectorEnv

GO_ON, REACH, FAIL = 0.0, 1.0, 2.0
EPISODE_LENGTH = 3


class Arm(NamedTuple):
    n_steps: jax.Array  # ()
    episode: jax.Array  # () a number that no other episode has


class ObedientEnv:
    """Its action says how a step ends; an observation is the number of the episode and of its steps."""

    def sample_noise(self, rng, n):
        return jax.random.uniform(rng, (n,))

    def reset_from(self, episode):
        arm = Arm(jnp.zeros((), jnp.int32), episode)
        zero = jnp.zeros(())
        return State(arm, self._observe(arm), zero, zero, {"unsettled": zero}, {"valid": jnp.array(True)})

    def step(self, state, action):
        valid = action[0] != FAIL
        arm = state.pipeline_state
        arm = arm._replace(n_steps=arm.n_steps + valid)
        return state.replace(
            pipeline_state=arm,
            obs=self._observe(arm),
            reward=10.0 * action[0],
            done=(action[0] != GO_ON).astype(jnp.float32),
            metrics={"unsettled": 1.0 - valid},
            info={"valid": valid},
        )

    def _observe(self, arm):
        return jnp.stack([arm.episode, arm.n_steps.astype(jnp.float32)])


def play(*script):
    """Each arm acts by its column of the script; returns the start and what each step returned."""
    arms = VectorEnv(ObedientEnv(), len(script[0]), EPISODE_LENGTH)
    step = jax.jit(arms.step)
    start = state = arms.reset(jax.random.key(0))
    history = []
    for index, row in enumerate(script):
        history.append(step(state, jnp.array(row)[:, None], jax.random.key(index + 1)))
        state = history[-1][0]
    return start, history


def test_an_arm_that_goes_on_is_not_touched():
    start, [(state, after, terminated, truncated)] = play([GO_ON] * 3)
    np.testing.assert_array_equal(state.obs, np.stack([start.obs[:, 0], np.ones(3)], axis=1))
    assert jax.tree.all(jax.tree.map(np.array_equal, state, after))
    assert not terminated.any() and not truncated.any() and after.info["valid"].all()


@pytest.mark.parametrize(
    ("script", "terminated", "truncated", "valid"),
    [
        pytest.param([REACH], True, False, True, id="reaches at once"),
        pytest.param([GO_ON, REACH], True, False, True, id="reaches later"),
        pytest.param([GO_ON, GO_ON, GO_ON], False, True, True, id="runs out of time"),
        pytest.param([GO_ON, GO_ON, REACH], True, False, True, id="reaches with its last action"),
        pytest.param([GO_ON, FAIL], False, False, False, id="fails"),
        pytest.param([GO_ON, GO_ON, FAIL], False, False, False, id="fails with its last action"),
    ],
)
def test_an_episode_ends_in_one_way_and_the_next_one_begins(script, terminated, truncated, valid):
    # The arm beside it only goes on, and has as long an episode as there is.
    start, history = play(*[[action, GO_ON] for action in script])
    state, after, *ends = history[-1]
    assert [bool(end[0]) for end in (*ends, after.info["valid"])] == [terminated, truncated, valid]
    # What the action led to belongs to the old episode, what follows to a new one without a step.
    np.testing.assert_array_equal(after.obs[0], [start.obs[0, 0], len(script) - (not valid)])
    assert state.obs[0, 0] != start.obs[0, 0] and state.obs[0, 1] == 0
    assert state.pipeline_state.n_steps[0] == 0 and state.done[0] == 0 and state.info["valid"][0]
    assert after.reward[0] == 10.0 * script[-1]
    assert state.metrics["unsettled"][0] == (not valid)  # counted, though the arm is a new one
    for _, before, *ends in history[:-1]:
        assert not np.array(ends)[:, 0].any() and before.info["valid"][0]
    assert [bool(end[1]) for end in history[-1][2:]] == [False, len(script) == EPISODE_LENGTH]


def test_a_new_episode_has_its_full_length():
    _, history = play([REACH, GO_ON], *[[GO_ON, GO_ON]] * 5)
    truncated = np.array([step[-1] for step in history])
    np.testing.assert_array_equal(np.flatnonzero(truncated[:, 0]), [3])  # one step later than
    np.testing.assert_array_equal(np.flatnonzero(truncated[:, 1]), [2, 5])
