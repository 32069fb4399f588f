"""The settling benchmark: errors, and a tiny run with a row for each method."""

import numpy as np

from benchmarks.speed import settle
from benchmarks.speed.jax_worker import mesh_of
from benchmarks.speed.truth import Truth, error_figures


def test_errors_are_distances_to_the_truth_without_the_arms_that_have_none():
    tips_mm = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    errors = error_figures(tips_mm, Truth(np.zeros((3, 3)), np.array([True, True, False]), 0.5))
    assert errors == {"median_mm": 3.0, "p95_mm": 4.8, "max_mm": 5.0, "without_truth": 1}


def test_smoke(monkeypatch):
    """Each method is near the truth; MJX is left out where it compiles for long."""
    for name, value in (("N_ARMS", 8), ("N_STEPPED", 2), ("N_ROUNDS", 2), ("ROUND_S", 0.01)):
        monkeypatch.setattr(settle, name, value)
    monkeypatch.setattr(settle, "MOST_LINKS_MJX", 1)
    chain, mjx, stepping = settle.methods_rows(2, mesh_of(8))
    assert mjx["skipped"] == settle.NO_MJX and chain["max_mm"] < 0.01 and stepping["max_mm"] < 1.5
    assert min(chain["solves_per_s"], stepping["solves_per_s"]) > 0
    assert chain["share_at_limit"] == stepping["share_at_limit"] > 0.2
