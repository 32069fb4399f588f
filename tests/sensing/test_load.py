"""The payload of an arm at rest: by hand, NumPy against JAX, and the average over rests."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag

from mjx_softarm.sensing.load import (
    JUMP,
    N_AVERAGED,
    N_PASSES,
    OWN_FACTOR,
    Load,
    LoadEstimator,
    averaged,
    estimate_load,
    holding,
)

N = 9


def estimator_of(rng):
    """An estimator with a hidden layer, all of whose numbers matter."""
    n_out, half = 2 * N + 3, rng.normal(size=(3, 3, 3))
    layers = ((rng.normal(size=(N, 5)), rng.normal(size=5)), (rng.normal(size=(5, n_out)), np.zeros(n_out)))
    centre = np.concatenate([np.full(N, -10.0), rng.uniform(3.0, 6.0, N), np.zeros(3)])
    scale = np.concatenate([np.full(N, 0.5), np.full(N, 0.1), np.full(3, 0.2)])
    plane = rng.normal(size=(N, n_out)), np.full(N, 0.2), np.full(N, 0.05), centre, scale
    known = half @ half.swapaxes(1, 2) + 0.5 * np.eye(3)
    hysteresis = rng.uniform(0.5, 1.0, N), np.full(N, 0.01)
    numbers = layers, *plane, known, np.tile(0.3 * np.eye(3), (3, 1, 1)), *hysteresis, 0.2, 0.8, 0.04
    return LoadEstimator(*jax.tree.map(np.float32, numbers))


def test_estimate_is_generalised_least_squares_with_all_covariances():
    rng = np.random.default_rng(2)
    estimator, spring_m = estimator_of(rng), rng.uniform(0.15, 0.25, (4, N))
    found = holding(estimator, spring_m)
    held_kpa, effect = (x.reshape(4, N).astype(float) for x in found[:2])
    pressure_kpa = held_kpa + 0.6 * effect + rng.normal(size=(4, N))
    told_kg, half_width_kg = estimate_load(estimator, spring_m, pressure_kpa)
    assert told_kg.dtype == np.float32
    in_jax = jax.jit(estimate_load)(estimator, *map(jnp.asarray, (spring_m, pressure_kpa)))
    np.testing.assert_allclose((told_kg, half_width_kg), in_jax, rtol=1e-4, atol=1e-5)
    for k in range(4):
        blocks = np.exp(found.log_share[k])[:, None, None] * estimator.covariance_kpa2 + estimator.error_kpa2
        kg, variance = 0.0, 0.0
        for _ in range(N_PASSES):
            factors = estimator.factor_sd**2 + OWN_FACTOR**2 * np.eye(N)
            covariance = block_diag(*blocks) + kg**2 * factors * np.outer(effect[k], effect[k])
            weight = np.linalg.solve(covariance, effect[k])
            variance = 1.0 / (weight @ effect[k])
            kg, before_kg = variance * weight @ (pressure_kpa[k] - held_kpa[k]), kg
        variance += estimator.factor_sd**2 * (kg**2 - before_kg**2)  # the last estimate's own
        assert told_kg[k] == pytest.approx(0.2 + kg, rel=1e-4)
        assert half_width_kg[k] == pytest.approx(1.96 * np.sqrt(variance), rel=1e-4)


def test_pressures_of_hysteresis_are_no_payload():
    rng = np.random.default_rng(5)
    estimator, spring_m = estimator_of(rng), rng.uniform(0.15, 0.25, (3, N))
    pressure_kpa, stop = rng.uniform(-40.0, 20.0, (3, N)), rng.uniform(-1.0, 1.0, (3, N))
    with_it = estimate_load(estimator, spring_m, pressure_kpa + estimator.hysteresis_kpa * stop, stop)
    without = estimate_load(estimator, spring_m, pressure_kpa)
    np.testing.assert_allclose(with_it, without, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("rests_kg", "kg", "n_estimates", "began"),
    [
        ([0.4, 0.5, 0.7, 0.6], 0.55, 4, False),
        ([*[0.5] * 100, 0.6], 0.5 + 0.1 / N_AVERAGED, N_AVERAGED, False),
        ([0.6, 0.6, 0.0, 0.6, 0.0], 0.6, 3, False),  # an odd one is forgotten
        ([0.6, 0.6, 0.6, 0.6 + 2 * JUMP, 0.65 + 2 * JUMP], 0.65 + 2 * JUMP, 1, True),  # two are not
        ([0.6, 0.6, 0.6, 0.6 - 2 * JUMP, 0.65 - 2 * JUMP], 0.65 - 2 * JUMP, 1, True),
        ([0.0, 0.6, 0.7, 0.7], 0.7, 2, False),
    ],
)
def test_rests_are_averaged_until_two_in_a_row_disagree(rests_kg, kg, n_estimates, began):
    load = Load(0.0)
    for rest_kg in rests_kg:
        load = averaged(load, rest_kg, 0.1, 1.0)
    assert load.kg == pytest.approx(kg) and (load.n_estimates, load.began) == (n_estimates, began)
    assert load.half_width_kg == pytest.approx(0.1)


def test_rests_whose_intervals_meet_do_not_disagree():
    wide = averaged(Load(0.0), 1.0, 0.2, 1.0)
    for kg, begins in ((0.65, False), (0.55, True)):
        assert averaged(averaged(wide, kg, 0.2, 1.0), kg, 0.2, 1.0).began is begins


@pytest.mark.parametrize(
    ("kg", "assumed_kg", "believed_kg"),
    [(0.1, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.2, 0.0, 0.15), (0.3, 0.2, 0.2), (0.4, 0.2, 0.35)],
)
def test_a_difference_from_the_assumed_payload_is_believed_as_far_as_known(kg, assumed_kg, believed_kg):
    load = Load(kg, 3, half_width_kg=1.96 * 0.1, assumed_kg=assumed_kg)
    assert load.believed_kg == pytest.approx(believed_kg)
