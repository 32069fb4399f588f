"""The payload of an arm at rest: the network by hand, NumPy against JAX, and the average over rests."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.sensing.load import (
    JUMP,
    N_AVERAGED,
    Load,
    LoadEstimator,
    averaged,
    estimate_load,
    load_half_width,
)

N = 9


def linear(of_springs, of_pressures, dtype=np.float32):
    """An estimator without hidden layers: weights of the normalised springs and pressures, and 0.1."""
    layer = np.concatenate([np.full(N, of_springs), np.full(N, of_pressures)])[:, None], np.full(1, 0.1)
    error = np.full((2 * N, 1), 0.5), np.full(1, -2.0)
    numbers = np.full(N, 0.2), np.full(N, 0.05), np.full(N, -10.0), np.full(N, 20.0), 0.8
    return LoadEstimator(*jax.tree.map(lambda x: np.asarray(x, dtype), ((layer,), (error,), *numbers)))


def after(*estimate_kg, width_kg=0.1):
    load = Load(0.0)
    for kg in estimate_kg:
        load = averaged(load, kg, width_kg, 1.0)
    return load


def test_network_by_hand():
    estimate_kg = estimate_load(linear(0.5, -0.25), np.full((4, N), 0.21), np.full((4, N), 10.0))
    np.testing.assert_allclose(estimate_kg, np.full(4, 0.8 * (9 * (0.5 * 0.2 - 0.25 * 1.0) + 0.1)), rtol=1e-5)
    assert estimate_kg.dtype == np.float32


def test_half_width_by_hand_and_its_limits():
    spring_m = np.array([[0.21], [0.2 + 0.05 * 10], [0.2 - 0.05 * 10]]) + np.zeros(N)
    shares = 1.96 * 0.8 * np.array([np.exp(9 * 0.5 * 0.2 - 2.0), 3.0, 1e-3])
    found_kg = load_half_width(linear(0.5, 0.2), spring_m, np.full((3, N), -10.0))
    np.testing.assert_allclose(found_kg, shares, rtol=1e-5)


def test_numpy_and_jax_agree():
    estimator, rng = linear(0.3, 0.2), np.random.default_rng(0)
    rows = rng.uniform(0.1, 0.25, (5, N)), rng.uniform(-40.0, 20.0, (5, N))
    in_jax = jax.jit(estimate_load)(estimator, *(jnp.asarray(x, jnp.float32) for x in rows))
    np.testing.assert_allclose(estimate_load(estimator, *rows), in_jax, rtol=1e-5, atol=1e-6)


def test_first_rest_replaces_what_was_assumed():
    assert after(0.7) == Load(0.7, 1, half_width_kg=0.1)


def test_rests_are_averaged():
    estimate_kg = 0.5 + 0.05 * np.random.default_rng(1).standard_normal(N_AVERAGED)
    assert after(*estimate_kg).kg == pytest.approx(estimate_kg.mean())
    late = after(*[0.5] * 100, 0.6)
    assert late.kg == pytest.approx(0.5 + 0.1 / N_AVERAGED) and late.n_estimates == N_AVERAGED


def test_an_average_is_known_as_well_as_its_estimates_are_in_the_mean():
    load = averaged(averaged(Load(0.0), 0.5, 0.1, 1.0), 0.5, 0.3, 1.0)
    assert load.half_width_kg == pytest.approx(0.2)
    assert after(*[0.5] * 50).half_width_kg == pytest.approx(0.1)


@pytest.mark.parametrize("change_kg", [-2 * JUMP, 2 * JUMP])
def test_two_rests_that_disagree_begin_a_new_average(change_kg):
    held = after(0.6, 0.6, 0.6)
    once = averaged(held, 0.6 + change_kg, 0.2, 1.0)
    assert once.kg == held.kg and not once.began
    again = averaged(once, 0.65 + change_kg, 0.2, 1.0)
    assert again == Load(0.65 + change_kg, 1, began=True, half_width_kg=0.2)
    assert not averaged(again, 0.65 + change_kg, 0.2, 1.0).began


def test_a_lighter_arm_s_average_begins_anew_sooner():
    load = averaged(averaged(Load(0.1, 3), 0.15, 0.0, 0.1), 0.15, 0.0, 0.1)
    assert load == Load(0.15, 1, began=True)
    assert not averaged(averaged(Load(0.1, 3), 0.15, 0.0, 1.0), 0.15, 0.0, 1.0).began


def test_one_odd_rest_is_forgotten():
    load = after(0.6, 0.6, 0.0, 0.6, 0.0)
    assert load.kg == pytest.approx(0.6) and not load.began


@pytest.mark.parametrize(
    ("kg", "assumed_kg", "believed_kg"),
    [(0.1, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.2, 0.0, 0.15), (0.3, 0.2, 0.2), (0.4, 0.2, 0.35)],
)
def test_a_difference_from_the_assumed_payload_is_believed_as_far_as_known(kg, assumed_kg, believed_kg):
    load = Load(kg, 3, half_width_kg=1.96 * 0.1, assumed_kg=assumed_kg)
    assert load.believed_kg == pytest.approx(believed_kg)
