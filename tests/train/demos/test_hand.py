"""Demonstrations by hand: sizes of noise and detours, and what is taken where the arm cannot go."""

from typing import NamedTuple

import numpy as np
import pytest

from train.demos.expert import LIMIT_SHARE, MARGIN_M, ExpertError
from train.demos.hand import DETOUR_M, N_TRIES, NOISE_M, STOP_NOISE_M, by_hand
from train.demos.waypoints import task

GRASP_M = 0.02  # distance within which the gripper takes an object


class Stop(NamedTuple):
    pressure_kpa: np.ndarray  # each is the number of postures so far
    finger_m: np.ndarray


class Anywhere:
    """An expert whose arm takes any position but those that it refuses."""

    def __init__(self, spec, refuses=lambda waypoint: False):
        self.spec, self.refuses, self.asked = spec, refuses, []

    def target(self, waypoint):
        return waypoint

    def reach(self, name, target, before_kpa):
        self.asked.append(name)
        if self.refuses(target):
            raise ExpertError(f"waypoint {name!r}")
        return Stop(before_kpa + 1.0, target.finger_m)


@pytest.fixture(scope="module")
def waypoints(spec):
    return task("pipe300", spec).waypoints


def is_detour(waypoint):
    return waypoint.name.startswith("detour to ")


def test_positions_are_off_by_noise_of_the_stated_size(spec, waypoints):
    passing_m, stops_m = [], []
    for seed in range(50):
        taken, plan = by_hand(Anywhere(spec), waypoints, seed)
        met = [waypoint for waypoint in taken if not is_detour(waypoint)]
        for one, scripted in zip(met, waypoints, strict=True):
            assert (one.name, one.turn) == (scripted.name, scripted.turn)
            (stops_m if one.operation else passing_m).append(one.finger_m - scripted.finger_m)
        # Each posture begins at the one before.
        np.testing.assert_array_equal(plan.pressure_kpa[:, 0], 1.0 + np.arange(len(taken)))
        np.testing.assert_array_equal(plan.finger_m, [waypoint.finger_m for waypoint in taken])
    for off_m, noise_m in ((passing_m, NOISE_M), (stops_m, STOP_NOISE_M)):
        np.testing.assert_allclose(np.std(off_m, axis=0), noise_m, rtol=0.15)
        np.testing.assert_allclose(np.mean(off_m, axis=0), 0.0, atol=0.2 * noise_m)
    assert np.linalg.norm(stops_m, axis=1).max() < GRASP_M


def test_a_third_of_the_moves_have_a_detour_beside_the_straight_way(spec, waypoints):
    taken, _ = by_hand(Anywhere(spec), waypoints, seed=0)
    at = [k for k, waypoint in enumerate(taken) if is_detour(waypoint)]
    assert len(at) == (len(waypoints) - 1) // 3 == len(taken) - len(waypoints)
    scripted_m = iter([waypoint.finger_m for waypoint in waypoints])
    for before, now in zip((None, *taken), taken, strict=False):
        if before is None or not is_detour(before):
            goal_m = next(scripted_m)  # of the move that begins
        if is_detour(now):
            aside_m, way_m = now.finger_m - 0.5 * (before.finger_m + goal_m), goal_m - before.finger_m
            assert np.linalg.norm(aside_m) == pytest.approx(DETOUR_M)
            assert aside_m @ way_m == pytest.approx(0.0, abs=1e-9)


def test_seed_tells_the_hand(spec, waypoints):
    one, same, other = (by_hand(Anywhere(spec), waypoints, seed)[1].finger_m for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.isin(one, other).any()


def test_position_that_cannot_be_taken_is_the_scripted_one(spec, waypoints):
    """The arm goes nowhere but to the scripted positions: all draws are tried, and no detour is left."""
    points = {tuple(waypoint.finger_m) for waypoint in waypoints}
    stiff = Anywhere(spec, lambda waypoint: tuple(waypoint.finger_m) not in points)
    taken, _ = by_hand(stiff, waypoints, seed=0)
    assert [waypoint.name for waypoint in taken] == [waypoint.name for waypoint in waypoints]
    np.testing.assert_array_equal([w.finger_m for w in taken], [w.finger_m for w in waypoints])
    n_detours = (len(waypoints) - 1) // 3
    assert len(stiff.asked) == (N_TRIES + 1) * len(waypoints) + N_TRIES * n_detours


def test_position_is_drawn_again(spec, waypoints):
    """An arm that refuses the first draw of each takes the second."""
    asked = []
    fussy = Anywhere(spec, lambda waypoint: asked.append(waypoint.name) or asked.count(waypoint.name) == 1)
    taken, _ = by_hand(fussy, waypoints[:-1], seed=0)  # each name once
    assert len(fussy.asked) == 2 * len(taken) and len(taken) > len(waypoints)
    met = [waypoint for waypoint in taken if not is_detour(waypoint)]
    assert all((a.finger_m != b.finger_m).all() for a, b in zip(met, waypoints[:-1], strict=True))


def test_scripted_position_that_cannot_be_met_is_named(spec, waypoints):
    with pytest.raises(ExpertError, match="waypoint 'pick right'"):
        by_hand(Anywhere(spec, lambda waypoint: waypoint.name == "pick right"), waypoints, seed=0)


def test_arm_in_the_pipe_comes_to_the_hand_s_positions(expert, waypoints):
    taken, plan = by_hand(expert, waypoints[:5], seed=0)
    assert len(taken) == 6  # a detour in one of four moves
    np.testing.assert_allclose(plan.finger_m, [waypoint.finger_m for waypoint in taken], atol=5e-4)
    assert plan.clearance_m.min() > LIMIT_SHARE * MARGIN_M
