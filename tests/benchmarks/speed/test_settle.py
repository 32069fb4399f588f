"""The settling benchmark's parts: truth, errors, rows of methods."""

import jax.numpy as jnp
import numpy as np

from benchmarks.speed import settle
from benchmarks.speed.truth import Truth, error_figures, random_references, settle_function
from tests.train.small import SHORT
from train.epoch.devices import mesh_of


def truth(tip_mm, settled=None):
    tip_mm = np.array(tip_mm, float)
    return Truth(tip_mm, np.ones(len(tip_mm), bool) if settled is None else np.array(settled), 0.5)


def test_errors_are_distances_to_the_truth_without_the_arms_that_have_none():
    found = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    errors = error_figures(found, truth(np.zeros((3, 3)), settled=[True, True, False]))
    assert errors == {"median_mm": 3.0, "p95_mm": 4.8, "max_mm": 5.0, "without_truth": 1}


def test_each_method_has_a_row_whether_it_was_measured_or_not(monkeypatch):
    asked = []

    def take_turns(workers, n_rounds):
        asked.append([worker._command[3:5] for worker in workers])
        told = [{"solves_per_s": rate, "tip_mm": [[0.0, 0.0, 2.0]] * 3} for rate in (10.0, 30.0, 20.0)]
        return {workers[0].name: told}, {worker.name: "no memory" for worker in workers[1:]}

    monkeypatch.setattr(settle, "take_turns", take_turns)
    monkeypatch.setattr(settle, "true_rest", lambda *_: truth(np.zeros((4, 3))))
    monkeypatch.setattr(settle, "MOST_LINKS_MJX", 2)
    monkeypatch.setattr(settle, "LINKS", (2, 3))
    rows = settle.measure()["over_links"]
    assert [len(programs) for programs in asked] == [3, 2]
    chain, mjx, stepping = rows[:3]
    assert chain["solves_per_s"] == 20.0 and chain["median_mm"] == 2.0
    assert chain["share_at_limit"] == 0.5
    assert mjx["failed"] == stepping["failed"] == "no memory"
    assert [row.get("skipped") for row in rows[3:]] == [None, settle.NO_MJX, None]


def test_spread_arms_settle_as_on_one_device(quick_compiler):
    reference = jnp.asarray(random_references(SHORT, 8), jnp.float32)
    one, spread = (settle_function(SHORT, mesh=mesh)(reference) for mesh in (None, mesh_of("2")))
    assert len(spread.q.sharding.device_set) == 2
    np.testing.assert_allclose(spread.q, one.q, atol=1e-5)
