"""An arm that a pilot steers: goals taken and given up, springs held, pressures let go, all ends vented."""

import numpy as np

from mjx_softarm.deploy.ending import DONE, FAULT, Ending
from mjx_softarm.deploy.link import VENT_KPA_PER_S
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.deploy.session import steer
from tests.linear_arm import CONTROLLER, DT_S, FAR, GOALS, SPRINGS_M, Leaking, LinearArm, read_m


def fly(orders, n_ticks, arm=None, **kwargs):
    """Orders by tick; after the last tick the pilot fails."""
    arm, ticks, states = arm or LinearArm(), iter(range(n_ticks)), []
    run = steer(
        arm, CONTROLLER, lambda: orders.get(next(ticks)), lambda state, row: states.append(state), **kwargs
    )
    return arm, states, run


def test_goals_come_and_go():
    _, _, run = fly({5: GOALS[:1], 20: GOALS[1:]}, 700)
    np.testing.assert_array_equal(run.log.goal[6], GOALS[0])
    np.testing.assert_array_equal(run.log.goal[30], GOALS[1])
    assert np.isnan(run.log.goal[:5]).all() and [a.goal.tolist() for a in run.arrivals] == [GOALS[1].tolist()]
    np.testing.assert_allclose(read_m(run.log)[-1], SPRINGS_M[1], atol=5e-4)  # held after the arrival


def test_a_chamber_that_is_lost_while_a_goal_is_dragged_vents():
    """Each goal is new, so the arm neither rests nor goes along a way."""
    dragged = dict.fromkeys(range(0, 1500, 20), GOALS[:1])
    arm, _, run = fly(dragged, 1500, Leaking(200))
    assert run.counts()[Fault.CHAMBER_LOST] == 1 and len(run.log.row) < 600
    np.testing.assert_array_equal(arm.command_kpa, 0.0)


def test_a_goal_that_is_refused_is_told_and_ends_nothing():
    """Goals of a pilot are not counted, so none is missed."""
    _, _, run = fly({0: np.array([FAR]), 50: GOALS[:1]}, 700)
    assert run.counts()[Fault.GOAL_OUTSIDE] == 1 and run._replace(ending=Ending()).status == DONE
    np.testing.assert_allclose(read_m(run.log)[-1], SPRINGS_M[0], atol=5e-4)


def test_hold_stops_the_arm_where_it_is():
    """The pilot fails at the end, which vents it."""
    arm, _, run = fly({0: GOALS, 12: "hold"}, 200)
    spring_m = read_m(run.log)
    assert np.isnan(run.log.goal[12:]).all() and run.arrivals == ()
    np.testing.assert_allclose(spring_m[-50:].mean(axis=0), spring_m[11], atol=1e-3)
    assert np.abs(run.log.pressure_kpa[-1]).max() > 1.0  # still under pressure
    assert run.status == FAULT and run.ending.vented and "Stop" in run.ending.cause
    np.testing.assert_array_equal(arm.command_kpa, 0.0)


def test_vent_lets_the_pressures_go_and_a_goal_brings_them_back():
    _, _, run = fly({0: GOALS, 60: "vent", 250: GOALS[:1]}, 600)
    kpa = run.log.pressure_kpa
    assert np.abs(np.diff(kpa[61:200], axis=0)).max() <= VENT_KPA_PER_S * DT_S + 1e-9
    assert np.all(np.diff(np.abs(kpa[61:200]), axis=0) <= 0.0) and not kpa[200:250].any()
    np.testing.assert_allclose(read_m(run.log)[-1], SPRINGS_M[0], atol=5e-4)


def test_to_hold_an_arm_without_references_changes_nothing():
    """One that was never moved stays without pressure, and one that is being vented goes on."""
    _, states, run = fly({5: "hold"}, 50)
    assert states[-1].command.reference_m is None and not run.log.pressure_kpa.any()
    _, _, run = fly({0: GOALS, 60: "vent", 65: "hold"}, 200)
    assert run.log.pressure_kpa[64].any() and not run.log.pressure_kpa[-1].any()


def test_a_run_without_a_log_does_not_grow():
    _, _, run = fly({0: GOALS}, 1200)
    assert len(run.log) == 1000 and run.log.row[-1] == 1001
    saved = []
    _, _, run = fly({0: GOALS}, 1200, save=saved.append)
    assert len(saved[0]) == 1200
