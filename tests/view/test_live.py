"""The live view without a browser: a channel that never waits, Stop and Vent that stand, cheap ticks."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.deploy.goals import with_goal
from mjx_softarm.deploy.loop import start
from mjx_softarm.deploy.session import steer
from mjx_softarm.view.live import PagePilot, place_poses
from tests.linear_arm import CONTROLLER, FAR, GOALS, LinearArm


class Inbox:
    """An end of the channel whose orders the test gives."""

    def __init__(self):
        self.asked, self.shown, self.closed = {}, [], SimpleNamespace(is_set=lambda: False)

    def take(self):
        asked, self.asked = self.asked, {}
        return asked

    def put(self, **values):
        self.shown.append(values)


@pytest.fixture
def inbox():
    return Inbox()


@pytest.fixture
def pilot(inbox):
    """A pilot of a real arm."""
    return PagePilot(inbox, SimpleNamespace(), CONTROLLER, lambda text: None)


def ask(pilot, inbox, **asked):
    inbox.asked = asked
    return pilot.orders()


def test_goals_are_obeyed_once_somebody_asks_for_motion(pilot, inbox):
    assert ask(pilot, inbox, goal=GOALS[0]) is None
    assert ask(pilot, inbox, follow=True) is None
    np.testing.assert_array_equal(ask(pilot, inbox, goal=GOALS[0]), GOALS[:1])
    assert len(ask(pilot, inbox, circle=True)) >= 40


def test_goals_are_clamped(pilot, inbox):
    (goal,) = ask(pilot, inbox, follow=True, goal=FAR)
    assert with_goal(start(CONTROLLER), FAR)[1]
    assert with_goal(start(CONTROLLER), goal)[1] == ()


@pytest.mark.parametrize("button", ["hold", "vent"])
def test_stop_and_vent_stand_against_a_flood_of_goals(pilot, inbox, button):
    ask(pilot, inbox, follow=True)
    orders = ask(pilot, inbox, goal=GOALS[0], follow=True, circle=True, **{button: True})
    assert orders == button
    assert all(ask(pilot, inbox, goal=goal) is None for goal in GOALS)
    assert ask(pilot, inbox, follow=True, goal=GOALS[0])


def test_closed_page_and_dead_server_are_told(inbox):
    lines = []
    pilot = PagePilot(inbox, SimpleNamespace(), CONTROLLER, lines.append)
    ask(pilot, inbox, pages=1)
    assert ask(pilot, inbox, pages=0) is None and "no page is open" in lines[-1]
    inbox.closed = SimpleNamespace(is_set=lambda: True)
    assert ask(pilot, inbox) == "hold" and "server has ended" in lines[-1]
    assert ask(pilot, inbox) is None and len(lines) == 2


def test_payloads_and_picking_and_placing_hang_a_mass_to_the_gripper_and_take_it_off(inbox):
    loads = []
    arm = SimpleNamespace(attach=loads.append)
    ask(PagePilot(inbox, arm, CONTROLLER, lambda text: None), inbox, payload_kg=0.25)
    assert loads == [0.25]
    loads.clear()
    pilot = PagePilot(inbox, arm, CONTROLLER, lambda text: None)
    goals = ask(pilot, inbox, place=True)[:6]
    state, row, held = start(CONTROLLER), {"time_s": 0.0}, []
    for goal in goals:
        pilot.look(with_goal(state, goal)[0], row)
        pilot.look(state._replace(arrived=True), row)
        held.append(inbox.shown[-1]["look"].payload_kg)
    assert loads == [held[1], 0.0] and held == [0.0, held[1], held[1], held[1], 0.0, 0.0] and held[1] > 0.1
    above, at, _, above_next, next_at, _ = place_poses(ArmSpec.default())
    assert above[2] > at[2] == next_at[2] < above_next[2] and at[0] > 50.0 > -50.0 > next_at[0]
    ask(pilot, inbox, goal=GOALS[0])  # somebody drags the goal in between
    pilot.look(state._replace(arrived=True), row)
    assert len(loads) == 2


@pytest.fixture
def flood(ends):
    """Goals without end from the other end of the channel."""
    over = threading.Event()

    def send():
        while not over.wait(0.001):
            ends[1].send({"goal": GOALS[0], "follow": True})

    thread = threading.Thread(target=send)
    thread.start()
    yield
    over.set()
    thread.join()


@pytest.mark.usefixtures("flood")
def test_a_frame_costs_the_loop_less_than_a_millisecond(ends):
    """The other end reads nothing, and sends goals without end."""
    pilot, spent_s = PagePilot(ends[0], LinearArm(), CONTROLLER, lambda text: None), []

    def timed(function, *args):
        began = time.perf_counter()
        result = function(*args)
        spent_s.append(time.perf_counter() - began)
        return result

    def orders():
        if len(spent_s) >= 2000:  # a thousand ticks
            raise KeyboardInterrupt
        return timed(pilot.orders)

    run = steer(LinearArm(), CONTROLLER, orders, lambda *tick: timed(pilot.look, *tick))
    median_ms = 1e3 * np.median(np.reshape(spent_s[:2000], (-1, 2)).sum(axis=1))
    assert median_ms < 1.0 and run.ending.cause == "interrupted" and run.ending.vented
