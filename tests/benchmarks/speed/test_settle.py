"""The settling benchmark's parts: truth, errors, rows of methods."""

from types import SimpleNamespace

import numpy as np

from benchmarks.speed import settle
from benchmarks.speed.truth import Truth, error_figures
from tests.train.small import SHORT


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
    monkeypatch.setattr(settle.postures, "rows", list)
    rows = settle.measure()["over_links"]
    assert [len(programs) for programs in asked] == [3, 2]
    chain, mjx, stepping = rows[:3]
    assert chain["solves_per_s"] == 20.0 and chain["median_mm"] == 2.0
    assert chain["share_at_limit"] == 0.5
    assert mjx["failed"] == stepping["failed"] == "no memory"
    assert [row.get("skipped") for row in rows[3:]] == [None, settle.NO_MJX, None]


def test_arms_that_stand_are_counted_by_where_they_end(monkeypatch):
    tips_mm = np.zeros((100, 4, 3))
    tips_mm[:, 1] += [6.0, 0.0, 0.0]  # on another branch
    tips_mm[-1, 2] += 1.0  # in motion
    result = np.array([0, 0, 0, 2])
    found = SimpleNamespace(tip_position_m=np.full((4, 3), 1e-5), settled=result == 0, result=result)
    monkeypatch.setattr(settle.postures, "rest_of", lambda *_: found)
    monkeypatch.setattr(settle.postures, "SteppedArms", lambda *_: SimpleNamespace(hold=lambda *_: tips_mm))
    row = settle.postures.figures(SHORT)
    assert (row["converged"], row["not_convex"]) == (3, 1)
    assert (row["settled_and_rest"], row["elsewhere"], row["settled_but_moves"]) == (2, 1, 1)
    assert row["rests_but_not_settled"] == 1 and row["max_mm"] == 0.0173
