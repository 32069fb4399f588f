"""Critics that observe a prediction: what teaches them, and what the prediction says of a known arm."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from mjx_softarm.mdp.observation import ERROR, GOAL, OBS_SIZE, POSE
from train.agent.tqc import COST_AHEAD, Critics, PredictiveCritics, Predictor

B, ACTION, SENSED = 64, 2, 5
OBS = OBS_SIZE + SENSED

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(scope="module")
def critics():
    return PredictiveCritics(Critics(2, 5, (16,)), Predictor((32,)), n_ahead=2)


@pytest.fixture(scope="module")
def batch():
    """Transitions of an arm whose first three coordinates move by the action, and whose goals stay."""
    rng = np.random.default_rng(0)
    obs, action = rng.normal(0, 0.1, (B, OBS)), rng.uniform(-1, 1, (B, ACTION))
    after = obs.copy()
    for part in (POSE, ERROR):
        after[:, part.start : part.start + ACTION] += 0.1 * action
    after[:, -ACTION:] = action
    return tuple(jnp.asarray(x, jnp.float32) for x in (obs, action, after))


@pytest.fixture(scope="module")
def params(critics, batch):
    return critics.init(jax.random.key(0), *batch[:2])


def test_the_loss_of_the_critics_teaches_them_alone_and_so_does_that_of_the_prediction(
    critics, params, batch
):
    by_critics = jax.jit(jax.grad(lambda params: jnp.sum(critics.apply(params, *batch[:2]))))(params)
    by_prediction = jax.jit(jax.grad(critics.loss))(params, *batch)
    for gradient, taught, other in (
        (by_critics, "critics", "predictor"),
        (by_prediction, "predictor", "critics"),
    ):
        assert optax.tree.norm(gradient[taught]) > 0.0 == optax.tree.norm(gradient[other])


def test_a_taught_prediction_follows_the_arm_whatever_the_goal(critics, params, batch):
    obs, action, after = batch
    optimizer = optax.adam(1e-2)

    def step(carry, _):
        params, state = carry
        change, state = optimizer.update(jax.grad(critics.loss)(params, *batch), state)
        return (optax.apply_updates(params, change), state), None

    start = (params, optimizer.init(params))
    (taught, _), _ = jax.lax.scan(step, start, None, length=400)
    assert critics.loss(taught, *batch) < 0.02 * critics.loss(params, *batch)
    predicted = critics.after(taught["predictor"], obs, action)
    moved = np.linalg.norm(after[:, ERROR] - obs[:, ERROR], axis=-1)
    missed = np.linalg.norm(predicted[:, ERROR] - after[:, ERROR], axis=-1)
    assert np.median(missed) < 0.1 * np.median(moved)
    np.testing.assert_array_equal(predicted[:, GOAL], obs[:, GOAL])
    np.testing.assert_array_equal(predicted[:, -ACTION:], action)
    # Another goal changes the error, not what the arm does.
    other = obs.at[:, GOAL].add(1.0).at[:, ERROR].add(-0.3)
    elsewhere = critics.after(taught["predictor"], other, action)
    np.testing.assert_allclose(elsewhere[:, ERROR] - predicted[:, ERROR], -0.3, atol=1e-6)


def test_the_quantiles_fall_with_the_predicted_errors(critics, params, batch):
    # Without the critics' own inputs, what remains is a constant less the weighted norms of the errors.
    obs, action, _ = batch
    blind = jax.tree.map(lambda x: x, params)
    first = blind["critics"]["params"]["hidden_0"]
    first["kernel"] = jnp.zeros_like(first["kernel"])
    ahead = critics.after(params["predictor"], obs, action)
    errors = [ahead[:, ERROR], critics.after(params["predictor"], ahead, action)[:, ERROR]]
    norms = sum(np.linalg.norm(error, axis=-1) for error in errors)  # of both actions
    quantiles = critics.apply(blind, obs, action)  # (B, C, M)
    fall = quantiles + COST_AHEAD / 2 * norms[:, None, None]
    np.testing.assert_allclose(fall, np.broadcast_to(fall[:1], fall.shape), atol=1e-4)
    slope = jax.grad(lambda action: jnp.sum(critics.apply(blind, obs, action)))(action)
    assert jnp.all(jnp.linalg.norm(slope, axis=-1) > 0.0)
