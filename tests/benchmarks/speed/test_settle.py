"""The settling benchmark's parts: truth, saturation, the goal by hand."""

from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.harness import common
from benchmarks.harness.rounds import Worker, working
from benchmarks.speed import settle
from benchmarks.speed.settle import GOAL_ARMS, SPREADS, no_goal, speed_goal, way
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


def test_the_whole_reach_is_what_may_be_commanded():
    reference = random_references(SPEC, 1000)
    assert reference.min() >= SPEC.springs.length_min_m and reference.max() <= SPEC.springs.length_max_m
    assert np.ptp(reference) > 0.98 * (SPEC.springs.length_max_m - SPEC.springs.length_min_m)


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


def test_a_way_s_figures_are_errors_of_the_arms_it_took_and_medians_of_rates():
    rounds = [
        {"solves_per_s": rate, "tip_mm": [[0.0, 0.0, 1.0]], "unsettled": 3} for rate in (10.0, 30.0, 20.0)
    ]
    errors = {"median_mm": 1.0, "p95_mm": 1.0, "max_mm": 1.0, "without_truth": 0}
    assert way(rounds, truth(np.zeros((2, 3)))) == {**errors, "solves_per_s": 20.0, "unsettled": 3}


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
def test_the_goal_asks_for_speed_and_precision_at_once(measured, failed, verdict, told):
    rows = [{"arms": n, "env_steps_per_s": rate, "p95_mm": mm} for n, (rate, mm) in measured.items()]
    row = speed_goal([*rows, *({"failed": why} for why in failed)])
    assert row["verdict"] == verdict and row["measured"] == told
    assert 1024 in GOAL_ARMS


def test_the_goal_is_skipped_without_two_cores_or_on_a_gpu():
    assert no_goal(1, "cpu") == "1 core here"
    assert no_goal(8, "gpu") == "jax does not run on the CPU here"
    assert no_goal(2, "cpu") == ""


@pytest.mark.parametrize("links, ways", [(2, {"chain", "stepping"}), (8, {"chain"})])
def test_a_way_that_fails_or_takes_too_long_has_a_row_that_says_why(monkeypatch, links, ways):
    monkeypatch.setattr(settle, "N_ARMS", 2)
    monkeypatch.setattr(settle, "true_rest", lambda spec, reference_m: truth(np.zeros((2, 3))))
    given = []

    def take_turns(workers, n_rounds):
        given.extend(worker.name.split(",")[0] for worker in workers)
        failing = {2: "mjx", 8: "stepping"}[links]
        told = {"1.0": {"solves_per_s": 10.0, "tip_mm": [[0.0, 0.0, 0.0]] * 2}}
        rounds = {w.name: [told] for w in workers if not w.name.startswith(failing)}
        return rounds, {w.name: f"{w.name}: no memory" for w in workers if w.name.startswith(failing)}

    monkeypatch.setattr(settle, "take_turns", take_turns)
    rows = {row["method"]: row for row in settle._ways(links, (1.0,))}
    assert rows.keys() == {"chain", "mjx", "stepping"}
    assert {method for method, row in rows.items() if row.get("solves_per_s") == 10.0} == ways
    if links == 2:
        assert rows["mjx"]["failed"] == "mjx, 2 links per section: no memory"
    else:
        assert "mjx" not in given and "compiles for minutes" in rows["mjx"]["skipped"]
        assert rows["stepping"]["failed"] == "stepping, 8 links per section: no memory"


def test_more_iterations_come_closer(monkeypatch):
    monkeypatch.setattr(settle, "ITERATIONS", (2, 8))
    reference = random_references(SMALL, 8)
    few, many = settle.over_iterations(SMALL, reference, true_rest(SMALL, reference))
    assert (few["iterations"], many["iterations"]) == (2, 8)
    assert many["median_mm"] < 0.5 < few["max_mm"]


@pytest.mark.parametrize(
    "n_arms, backend, n_devices",
    [(1, "cpu", 1), (7, "cpu", 1), (8, "cpu", 2), (9, "cpu", 3), (10, "cpu", 2), (9, "gpu", 1)],
)
def test_arms_are_spread_evenly_over_the_cores(n_arms, backend, n_devices, monkeypatch):
    asked = {}
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(common, "mesh_of", lambda devices: mock.Mock(size=int(devices)))
    monkeypatch.setattr(common, "n_cores", lambda: 3)
    monkeypatch.setattr(jax.config, "update", asked.__setitem__)  # JAX runs already
    mesh = common.mesh_of_cores(n_arms)
    assert asked == {"jax_num_cpu_devices": 3}
    assert n_devices == (1 if mesh is None else mesh.size)


def test_spread_arms_settle_as_on_one_device():
    reference = jnp.asarray(random_references(SMALL, 8), jnp.float32)
    one, spread = (settle_function(SMALL, mesh=mesh)(reference) for mesh in (None, mesh_of("2")))
    assert len(spread.q.sharding.device_set) == 2
    np.testing.assert_allclose(spread.q, one.q, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("way_to", ["chain", "stepping"])
def test_a_worker_tells_where_the_arms_settle(tmp_path, way_to):
    reference = random_references(SMALL, 64)
    file = str(tmp_path / "references.npz")
    np.savez(file, **{"1.0": reference})
    program = ["benchmarks.speed.mujoco_worker", "settle", file, "2"]
    if way_to == "chain":
        program = ["benchmarks.speed.jax_worker", "settle", "chain", file, "2"]
    worker = Worker(way_to, program)
    with working(worker):
        told = worker.round()["1.0"]
    found = way([told], true_rest(SMALL, reference))
    assert found["p95_mm"] < 1.0 and found["without_truth"] == 0 and found["solves_per_s"] > 0
