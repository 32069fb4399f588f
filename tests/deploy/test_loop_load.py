"""The payload in the loop: estimated at rest, believed in the pose, made up for at the goal; its faults."""

import dataclasses
import functools

import numpy as np
import pytest

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.deploy.session import trace
from mjx_softarm.mdp.observation import layouts
from mjx_softarm.sensing.estimator import estimate
from mjx_softarm.sensing.hysteresis import stop_after
from tests.linear_arm import (
    GAIN_M_PER_KPA,
    LAG,
    LOAD,
    POLICY,
    REST_M,
    SPEC,
    LinearArm,
    N,
    asking,
    changed,
    go,
    load_estimator_of,
    read_m,
)

STRETCH_M_PER_KG = 0.004  # of each spring, at held pressures
SINK_M_PER_KG = 0.005  # of each section's end, at held springs
HYSTERESIS_KPA, STROKE_M = 1.0, 0.004
GOAL = np.array([0.0, 0.0, -585.0, 0.0, 0.0, 0.0])


def loaded_policy():
    """The linear arm's policy, whose estimators are exact for payloads on it."""
    effect = np.linalg.pinv(GAIN_M_PER_KPA) @ np.full(N, -STRETCH_M_PER_KG)  # (n,) [kPa / kg]
    return dataclasses.replace(
        POLICY,
        load_estimator=load_estimator_of(SPEC, effect),
        estimator=changed(POLICY.estimator, [0.0, 0.0, -SINK_M_PER_KG, 0.0, 0.0, 0.0], (LOAD,)),
    )


def plan_unloaded(pose, goal, spring_m, sensed):
    """Springs of the straight arm at the goal's height, without a payload."""
    return np.full(N, -1e-3 * goal[2] / 3)


LOADED = loaded_policy()
CONTROLLER = Controller.of(LOADED, plan_unloaded)


def follow(arm, controller=CONTROLLER, goals=(GOAL,), **kwargs):
    return go(arm, list(goals), controller, **kwargs)


class LoadedArm(LinearArm):
    """A linear arm that carries a payload from a tick until another."""

    def __init__(self, payload_kg, until=10**6, since=0):
        super().__init__()
        self._payload_kg, self._when = payload_kg, range(since, until)

    @property
    def payload_kg(self):
        return self._payload_kg if self.tick in self._when else 0.0

    @property
    def spring_m(self):
        return super().spring_m + STRETCH_M_PER_KG * self.payload_kg


@pytest.mark.parametrize("payload_kg", [0.0, 0.6])
def test_payload_is_estimated_at_rest_and_believed_in_the_pose(payload_kg):
    run = follow(LoadedArm(payload_kg))
    assert run.log.load_kg[0] == 0.0 and run.log.load_kg[-1] == pytest.approx(payload_kg, abs=0.03)
    pose = estimate(LOADED.estimator, read_m(run.log)[-1], run.log.load_kg[-1])
    np.testing.assert_allclose(run.log.estimate[-1], pose, atol=1e-3)
    assert run.counts() == {}


class Hysteretic(LinearArm):
    """Chambers that have grown hold their length with more pressure than chambers that have shrunk."""

    def __init__(self):
        super().__init__()
        self._stop, self._stroke_m = np.zeros(N), np.full(N, STROKE_M)

    def holds(self, pressure_kpa):
        before_m, held_kpa = self.spring_m, pressure_kpa - HYSTERESIS_KPA * self._stop
        moved_m = LAG * GAIN_M_PER_KPA @ (held_kpa - self.actual_kpa)
        self._stop = stop_after(self._stop, before_m + moved_m - self.spring_m, self._stroke_m)
        return held_kpa


@pytest.mark.parametrize("known", [True, False])
def test_hysteresis_is_no_payload_where_it_is_known(known):
    model = LOADED.load_estimator
    if known:
        both = np.full(N, HYSTERESIS_KPA, np.float32), np.full(N, STROKE_M, np.float32)
        model = model._replace(hysteresis_kpa=both[0], stroke_m=both[1])
    goals = [GOAL - [0.0, 0.0, 30.0, 0.0, 0.0, 0.0], GOAL, GOAL - [0.0, 0.0, 15.0, 0.0, 0.0, 0.0]]
    policy = dataclasses.replace(LOADED, load_estimator=model)
    run = follow(Hysteretic(), Controller.of(policy, plan_unloaded), goals)
    told_kg = [run.log.load_kg[arrival.row] for arrival in run.arrivals]
    assert np.abs(told_kg).max() < 0.03 if known else np.abs(told_kg).max() > 0.1


_WIDE = (np.zeros((len(layouts(SPEC)["payload"]), N), np.float32), np.zeros(N, np.float32))
CARRYING = dataclasses.replace(LOADED, layers=(_WIDE,), observation="payload")


@pytest.mark.parametrize("payload_kg", [0.6, 1.4])
@pytest.mark.parametrize("moves", [False, True])
def test_a_policy_that_observes_the_payload_is_given_its_estimate_up_to_the_largest(payload_kg, moves):
    plan, asked = asking(plan_unloaded)
    goals, controller = np.array([GOAL, GOAL + [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]]), Controller.of(CARRYING, plan)
    drive = functools.partial(trace, pace_s=3.0) if moves else follow
    drive(LoadedArm(payload_kg), controller, goals)
    first, last = asked[0][3][0], asked[-1][3][0]
    assert first == 0.0 and last == pytest.approx(min(payload_kg, 1.0), abs=0.03)


@pytest.mark.parametrize("since", [0, 90, 120])
def test_a_payload_that_the_policy_observes_is_made_up_for_once(since):
    """The plan is exact, so no goal is to be shifted, whenever the payload comes to be known."""
    plan, asked = asking(lambda *at: plan_unloaded(*at) - SINK_M_PER_KG * float(at[3][0]))
    policy = dataclasses.replace(CARRYING, n_actions=6)
    run = follow(LoadedArm(0.8, since=since), Controller.of(policy, plan))
    np.testing.assert_allclose([at[1] for at in asked], np.tile(GOAL, (6, 1)), atol=1.0)
    [arrival] = run.arrivals
    assert arrival.estimate[2] == pytest.approx(GOAL[2], abs=2.0) and arrival.reached


def test_goal_is_shifted_by_what_the_payload_bends():
    run = follow(LoadedArm(0.8))
    [arrival] = run.arrivals
    tip_mm = -1e3 * (read_m(run.log)[arrival.row].mean() * 3 + 3 * SINK_M_PER_KG * 0.8)
    assert tip_mm == pytest.approx(GOAL[2], abs=2.0)  # 12 mm off without
    assert arrival.reached and arrival.estimate[2] == pytest.approx(GOAL[2], abs=2.0)


@pytest.mark.parametrize(("wrong", "n_asked", "taken"), [(10.0, 4, 0), (2.5, 7, 3)])
def test_a_shift_that_leads_away_is_made_smaller_or_ends_the_goal(wrong, n_asked, taken):
    """The plan is 3 mm off, and answers a shift the other way: it leaves 33, 18, 10.5 mm, or 10.5, 6.8, 4.9.

    A goal allows 5.4 mm.
    """
    asked_mm, references_m = [], []

    def plan(pose, goal, spring_m, sensed):
        asked_mm.append(goal[2] - GOAL[2])
        answer = GOAL + [0.0, 0.0, 3.0 - wrong * asked_mm[-1], 0.0, 0.0, 0.0]
        references_m.append(plan_unloaded(pose, answer, spring_m, sensed))
        return references_m[-1]

    run = follow(LinearArm(), Controller.of(LOADED, plan))
    assert len(asked_mm) == n_asked and [arrival.reached for arrival in run.arrivals] == [True]
    np.testing.assert_allclose(asked_mm[1:4], asked_mm[1] * np.array([1.0, 0.5, 0.25]))
    np.testing.assert_array_equal(run.log.reference_m[-1], references_m[taken])


@pytest.mark.parametrize("action_s", [0.0, 1.0])
def test_shift_ends_somewhere_and_the_next_goal_has_none_of_it(action_s):
    plan, asked = asking(lambda *at: np.full(N, REST_M))  # never there
    far = GOAL + [0.0, 0.0, 40.0, 0.0, 0.0, 0.0]
    policy = dataclasses.replace(LOADED, action_s=action_s)
    follow(LinearArm(), Controller.of(policy, plan), [far, GOAL])
    asked_mm = np.array([goal[2] for _, goal, *_ in asked])
    n_of_goal = len(asked_mm) // 2
    assert asked_mm[::n_of_goal].tolist() == [far[2], GOAL[2]]
    assert np.abs(asked_mm[:n_of_goal] - far[2]).max() == 25.0


def test_saturated_chambers_shift_by_where_their_springs_are():
    plan, asked = asking(lambda *at: np.full(N, REST_M + 0.06))  # beyond what 20 kPa make
    longest_m = REST_M + GAIN_M_PER_KPA[0].sum() * POLICY.gains.pressure_max_kpa
    goal = np.array([0.0, 0.0, 10.0 - 3e3 * longest_m, 0.0, 0.0, 0.0])
    run = follow(LinearArm(), Controller.of(LOADED, plan), [goal])
    assert run.counts()[Fault.SATURATED] and len(asked) == 4
    assert asked[1][1][2] - goal[2] == pytest.approx(10.0, abs=1.0)


def test_object_that_drops_is_reported():
    lines = []
    goals = [GOAL, GOAL + [0.0, 0.0, 10.0, 0.0, 0.0, 0.0]]
    run = follow(LoadedArm(0.6, until=250), goals=goals, tell=lines.append)
    assert run.counts() == {Fault.LOAD_LOST: 1} and len(run.arrivals) == 2
    assert run.log.load_kg[240] == pytest.approx(0.6, abs=0.03)
    assert run.log.load_kg[-1] == pytest.approx(0.0, abs=0.03)
    [line] = [line for line in lines if "load lost" in line]
    assert 550.0 < float(line.split("from ")[1].split(" g")[0]) < 650.0


@pytest.mark.parametrize(
    ("payload_kg", "sd", "fault", "load_kg", "message"),
    [
        (1.45, 1.0, Fault.OVERLOADED, 1.45, "expected at most 1000 g"),
        (2.5, 1.0, Fault.LOAD_UNKNOWN, 0.0, "the pose is estimated with 0 g"),
        # A calibration that shows a payload four times worse
        (0.6, 4.0, Fault.LOAD_UNKNOWN, 0.0, "payload not known better than 398 g, expected 300 g"),
    ],
)
def test_overload_and_what_no_payload_explains_are_reported(payload_kg, sd, fault, load_kg, message):
    model = LOADED.load_estimator
    model = model._replace(covariance_kpa2=sd**2 * model.covariance_kpa2)
    policy = dataclasses.replace(LOADED, load_estimator=model)
    run = follow(LoadedArm(payload_kg), Controller.of(policy, plan_unloaded))
    assert set(run.counts()) == {fault} and message in run.events[0].message
    assert run.log.load_kg[-1] == pytest.approx(load_kg, abs=0.03 * (load_kg > 0.0))


def test_a_fault_of_the_payload_is_told_once_until_the_payload_changes():
    """The arm carries too much at the first and the last of three goals, and is counted each half second."""
    lines, heights = [], (0.0, 10.0, 20.0)
    goals = [GOAL + [0.0, 0.0, up_mm, 0.0, 0.0, 0.0] for up_mm in heights]
    arm = LoadedArm(2.5)
    loads_kg = iter((0.0, 2.5, 2.5))

    def next_load(goal):
        arm._payload_kg = next(loads_kg)

    run = follow(arm, goals=goals, tell=lines.append, arrived=next_load)
    told = [line for line in lines if "load unknown" in line]
    assert len(told) == 2 and run.counts()[Fault.LOAD_UNKNOWN] > 6 and len(run.arrivals) == 3


def test_pressure_that_is_not_measured_is_the_one_in_force():
    class Gaps(LoadedArm):
        def pressures(self):
            return np.where(np.arange(N) == self.tick % N, np.nan, self.actual_kpa)

    assert follow(Gaps(0.5)).log.load_kg[-1] == pytest.approx(0.5, abs=0.05)
