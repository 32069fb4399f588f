"""The settling benchmark's parts: truth, saturation, the goal by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.speed import settle
from benchmarks.speed.settle import SPREADS, TARGET_ARMS, speed_target
from benchmarks.speed.truth import (
    Truth,
    error_figures,
    random_references,
    settle_function,
    told_error,
    true_rest,
)
from mjx_softarm import ArmSpec
from train.epoch.devices import mesh_of

SPEC = ArmSpec.default()
SMALL = SPEC.replace(structure={"links_per_section": 2})
N = 64


def truth(tip_mm, settled=None):
    tip_mm = np.array(tip_mm, float)
    return Truth(tip_mm, np.ones(len(tip_mm), bool) if settled is None else np.array(settled), 0.5)


def test_references_that_reach_further_saturate_more_chambers_from_none_to_most():
    shares = [true_rest(SPEC, random_references(SPEC, N, reach)).share_at_limit for reach in SPREADS]
    assert (np.diff(shares) > 0.02).all()
    assert shares[0] < 0.01 and shares[-1] > 0.55
    assert 1.0 in SPREADS  # the row of each number of links


def test_errors_are_distances_to_the_truth_without_the_arms_that_have_none():
    found = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    errors = error_figures(found, truth(np.zeros((3, 3)), settled=[True, True, False]))
    assert errors == {"median_mm": 3.0, "p95_mm": 4.8, "max_mm": 5.0, "without_truth": 1}


def test_the_error_of_what_a_program_told_is_that_of_its_tips():
    reference = random_references(SPEC, 4)
    exact_mm = true_rest(SPEC, reference).tip_mm
    told = [
        {"reference_m": reference[k : k + 2].tolist(), "tip_mm": (exact_mm[k : k + 2] + [0, 0, 2]).tolist()}
        for k in (0, 2)
    ]
    assert told_error(SPEC, [{"arms": 2}, *told])["median_mm"] == pytest.approx(2.0, abs=1e-3)
    assert told_error(SPEC, [{"arms": 2}]) == {}


@pytest.mark.parametrize(
    "measured, failed, verdict, told",
    [
        ({128: (9_000, 0.1), 512: (10_000, 0.5)}, [], "met", "10,000 with 512 arms, 0.5 mm"),
        ({128: (9_999, 0.1)}, [], "NOT MET", "9,999 with 128 arms, 0.1 mm"),
        ({128: (12_000, 0.51), 512: (3, 0.1)}, [], "NOT MET", "12,000 with 128 arms, 0.51 mm"),
        ({128: (12_000, 0.2)}, ["b: gone"], "met", "12,000 with 128 arms, 0.2 mm; b: gone"),
        ({}, ["a: no memory", "b: gone"], "NOT MET", "a: no memory; b: gone"),
    ],
)
def test_the_target_asks_for_speed_and_precision_at_once(measured, failed, verdict, told):
    rows = [{"arms": n, "env_steps_per_s": rate, "p95_mm": mm} for n, (rate, mm) in measured.items()]
    row = speed_target([*rows, *({"failed": why} for why in failed)])
    assert row["verdict"] == verdict and row["measured"] == told
    assert 1024 in TARGET_ARMS


def test_more_iterations_come_closer(monkeypatch):
    monkeypatch.setattr(settle, "ITERATIONS", (2, 8))
    reference = random_references(SMALL, 8)
    few, many = settle.over_iterations(SMALL, reference, true_rest(SMALL, reference))
    assert (few["iterations"], many["iterations"]) == (2, 8)
    assert many["median_mm"] < 0.5 < few["max_mm"]


def test_spread_arms_settle_as_on_one_device():
    reference = jnp.asarray(random_references(SMALL, 8), jnp.float32)
    one, spread = (settle_function(SMALL, mesh=mesh)(reference) for mesh in (None, mesh_of("2")))
    assert len(spread.q.sharding.device_set) == 2
    np.testing.assert_allclose(spread.q, one.q, atol=1e-5)
