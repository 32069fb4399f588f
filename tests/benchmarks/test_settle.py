"""The settling benchmark's parts: truth, saturation, the goal by hand, counted operations."""

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
import pytest

from benchmarks.floor import counted, settle_cost
from benchmarks.settle import GOAL_ARMS, REACHES, speed_goal, way
from benchmarks.truth import Truth, error_figures, random_references, told_error, true_rest
from mjx_softarm import ArmSpec

SPEC = ArmSpec.default()
N = 64


def truth(tip_mm, settled=None):
    tip_mm = np.array(tip_mm, float)
    return Truth(tip_mm, np.ones(len(tip_mm), bool) if settled is None else np.array(settled), 0.5)


def test_references_that_reach_further_saturate_more_chambers_from_none_to_most():
    shares = [true_rest(SPEC, random_references(SPEC, N, reach)).share_at_limit for reach in REACHES]
    assert (np.diff(shares) > 0.02).all()
    assert shares[0] < 0.01 and shares[-1] > 0.55
    assert 1.0 in REACHES  # the row of each number of links


def test_the_whole_reach_is_what_may_be_commanded():
    reference = random_references(SPEC, 1000)
    assert reference.min() >= SPEC.springs.length_min_m and reference.max() <= SPEC.springs.length_max_m
    assert np.ptp(reference) > 0.98 * (SPEC.springs.length_max_m - SPEC.springs.length_min_m)


def test_errors_are_distances_to_the_truth_without_the_arms_that_have_none():
    found = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    errors = error_figures(found, truth(np.zeros((3, 3)), settled=[True, True, False]))
    assert errors == {"median_mm": 3.0, "p95_mm": 4.8, "max_mm": 5.0}


def test_the_error_of_what_a_program_told_is_that_of_its_tips():
    reference = random_references(SPEC, 4)
    exact_mm = true_rest(SPEC, reference).tip_mm
    told = [
        {"reference_m": reference[k : k + 2].tolist(), "tip_mm": (exact_mm[k : k + 2] + [0, 0, 2]).tolist()}
        for k in (0, 2)
    ]
    assert told_error(SPEC, [{"arms": 2}, *told])["median_mm"] == pytest.approx(2.0, abs=1e-3)
    assert told_error(SPEC, [{"arms": 2}]) == {}


def test_a_way_s_figures_are_those_of_its_set_of_references():
    rounds = [
        {
            "solves_per_s": {"0.1": 1.0, "1.0": rate},
            "sets": {
                "0.1": {"tip_mm": [[9.0, 9.0, 9.0]]},
                "1.0": {"tip_mm": [[0.0, 0.0, 1.0]], "unsettled": 3},
            },
            "peak_rss_mb": 7,
        }
        for rate in (10.0, 30.0, 20.0)
    ]
    found = way(rounds, "1.0", truth(np.zeros((2, 3))))  # it was given fewer arms than there are truths
    assert found == {
        "median_mm": 1.0,
        "p95_mm": 1.0,
        "max_mm": 1.0,
        "solves_per_s": 20.0,
        "unsettled": 3,
        "peak_rss_mb": 7,
    }


@pytest.mark.parametrize(
    "measured, n_cores, verdict, told",
    [
        ({128: (9_000, 0.1), 512: (10_000, 0.5)}, 2, "met", "10,000 with 512 arms, 0.5 mm"),
        ({128: (9_999, 0.1)}, 2, "NOT MET", "9,999 with 128 arms, 0.1 mm"),
        ({128: (12_000, 0.51), 512: (3, 0.1)}, 8, "NOT MET", "12,000 with 128 arms, 0.51 mm"),
        ({}, 1, "skipped", "1 core here"),
        ({}, 8, "skipped", "jax does not run on the CPU here"),
    ],
)
def test_the_goal_wants_speed_and_precision_at_once(measured, n_cores, verdict, told):
    row = speed_goal(measured, n_cores)
    assert row["verdict"] == verdict and row["measured"] == told
    assert 1024 in GOAL_ARMS


def test_operations_are_counted_with_those_of_libraries():
    n, k, batch = 12, 3, 5

    def solve(matrix, columns):
        factor = jax.scipy.linalg.cho_factor(matrix, lower=True)
        return jax.scipy.linalg.cho_solve(factor, columns)

    function = jax.jit(jax.vmap(solve))
    arguments = (jnp.broadcast_to(jnp.eye(n), (batch, n, n)), jnp.ones((batch, n, k)))
    flop, moved = counted(function, function.lower(*arguments).compile(), *arguments)
    exact = batch * (n**3 / 3 + 2 * n**2 * k)
    assert exact <= flop < 2 * exact  # and some checks of what comes out
    assert moved > 4 * batch * (n * n + n * k)
    product, rows = jax.jit(jnp.matmul), jnp.ones((n, n))
    assert counted(product, product.lower(rows, rows).compile(), rows, rows)[0] == 2 * n**3


def test_a_turn_of_the_settling_loop_costs_a_factorisation_and_more():
    n, n_arms = 3 * SPEC.n_links, 2
    outside, turn, n_outside = settle_cost(SPEC, jnp.asarray(random_references(SPEC, n_arms), jnp.float32))
    least = n_arms * (n**3 / 3 + 2 * n**2 * (1 + SPEC.n_chambers))
    assert turn.flop > least and turn.moved > 4 * n_arms * n**2
    assert outside.flop > 0 and 0 <= n_outside <= 1
