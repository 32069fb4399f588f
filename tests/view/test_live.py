"""The live view without a browser: a channel that never waits, Stop and Vent that stand, cheap ticks."""

import threading
import time
from multiprocessing import Pipe
from types import SimpleNamespace

import numpy as np
import pytest

from mjx_softarm.deploy.controller import start
from mjx_softarm.deploy.loop import with_goal
from mjx_softarm.deploy.session import Orders, steer
from mjx_softarm.view.channel import End
from mjx_softarm.view.live import Paced, PagePilot
from tests.linear_arm import CONTROLLER, DT_S, FAR, GOALS, LinearArm


def wait_for(condition, seconds=10.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def taken(end, name):
    """All values that come until one of this name does."""
    found = {}
    wait_for(lambda: found.update(end.take()) or name in found)
    return found


@pytest.fixture
def ends():
    ours, theirs = Pipe()
    return End(ours), theirs


def test_channel_keeps_the_newest_of_each_name(ends):
    end, other = ends
    other.send({"goal": 1})
    other.send({"vent": True, "goal": 2})
    other.send({"goal": 3, "last": True})
    assert taken(end, "last") == {"vent": True, "goal": 3, "last": True} and end.take() == {}
    end.put(look=1, doing="x")
    wait_for(other.poll)
    assert other.recv() == {"look": 1, "doing": "x"}


def test_other_end_that_reads_nothing_costs_no_time_and_no_memory(ends):
    end, other = ends
    longest = 0.0
    for k in range(3000):  # far more than a pipe holds
        began = time.perf_counter()
        end.put(look=np.full(100, float(k)))
        longest = max(longest, time.perf_counter() - began)
    assert longest < 0.1  # a write that waited would never return
    assert len(end._out) <= 1
    seen = []
    wait_for(lambda: seen.append(other.recv()["look"][0]) or seen[-1] == 2999.0)
    assert len(seen) < 3000 and seen == sorted(seen)


def test_lost_end_is_seen(ends):
    end, other = ends
    other.close()
    assert end.closed.wait(5.0)
    end.put(look=1)
    assert end.take() == {}


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


def ask(pilot, inbox, **asked):
    inbox.asked = asked
    return pilot.orders()


def real_arm():
    return SimpleNamespace()


def test_goals_are_obeyed_once_somebody_asks_for_motion(inbox):
    pilot = PagePilot(inbox, real_arm(), CONTROLLER, lambda text: None)
    assert ask(pilot, inbox, goal=GOALS[0]) == Orders()
    assert ask(pilot, inbox, follow=True) == Orders()
    np.testing.assert_array_equal(ask(pilot, inbox, goal=GOALS[0]).goals, GOALS[:1])
    assert len(ask(pilot, inbox, circle=True).goals) >= 40


def test_goals_are_clamped(inbox):
    pilot = PagePilot(inbox, real_arm(), CONTROLLER, lambda text: None)
    (goal,) = ask(pilot, inbox, follow=True, goal=FAR).goals
    assert with_goal(CONTROLLER, start(CONTROLLER), FAR)[1]
    assert with_goal(CONTROLLER, start(CONTROLLER), goal)[1] == ()


@pytest.mark.parametrize("button", ["hold", "vent"])
def test_stop_and_vent_stand_against_a_flood_of_goals(inbox, button):
    pilot = PagePilot(inbox, real_arm(), CONTROLLER, lambda text: None)
    ask(pilot, inbox, follow=True)
    orders = ask(pilot, inbox, goal=GOALS[0], follow=True, circle=True, **{button: True})
    assert orders == Orders(vent=button == "vent", hold=True)
    assert all(ask(pilot, inbox, goal=goal) == Orders() for goal in GOALS)
    assert ask(pilot, inbox, follow=True, goal=GOALS[0]).goals


def test_closed_page_and_dead_server_are_told(inbox):
    lines = []
    pilot = PagePilot(inbox, real_arm(), CONTROLLER, lines.append)
    ask(pilot, inbox, pages=1)
    assert ask(pilot, inbox, pages=0) == Orders() and "no page is open" in lines[-1]
    inbox.closed = SimpleNamespace(is_set=lambda: True)
    assert ask(pilot, inbox) == Orders(hold=True) and "server has ended" in lines[-1]
    assert ask(pilot, inbox) == Orders() and len(lines) == 2


def test_payload_is_attached(inbox):
    arm, loads = SimpleNamespace(), []
    arm.attach = loads.append
    ask(PagePilot(inbox, arm, CONTROLLER, lambda text: None), inbox, payload_kg=0.25)
    assert loads == [0.25]


class Timed(PagePilot):
    """Ends after some ticks, and times its part of each."""

    def __init__(self, *args, n_ticks):
        super().__init__(*args)
        self.left, self.spent_s = n_ticks, []

    def orders(self):
        self.left -= 1
        if not self.left:
            raise KeyboardInterrupt
        began = time.perf_counter()
        found = super().orders()
        self.spent_s.append(time.perf_counter() - began)
        return found

    def look(self, *args):
        began = time.perf_counter()
        super().look(*args)
        self.spent_s[-1] += time.perf_counter() - began


@pytest.fixture
def flood(ends):
    """Goals without end from the other end of the channel, once it is started."""
    over = threading.Event()

    def send():
        while not over.wait(0.001):
            ends[1].send({"goal": GOALS[0], "follow": True})

    thread = threading.Thread(target=send)
    yield thread
    over.set()
    if thread.is_alive():
        thread.join()


@pytest.mark.parametrize("floods", [False, True])
def test_a_frame_costs_the_loop_less_than_a_millisecond(ends, flood, floods):
    """The other end reads nothing, and sends goals without end."""
    arm = LinearArm()
    pilot = Timed(ends[0], arm, CONTROLLER, lambda text: None, n_ticks=1000)
    if floods:
        flood.start()
    run = steer(arm, CONTROLLER, pilot)
    median_ms = 1e3 * np.median(pilot.spent_s)
    print(f"a frame costs the loop {median_ms:.3f} ms in the median")
    assert median_ms < 1.0 and run.ending.cause == "interrupted" and run.ending.vented


def test_paced_arm_keeps_real_time():
    arm = Paced(LinearArm())
    began = time.monotonic()
    for _ in range(20):
        arm.write_pressures(np.zeros(9))
    assert time.monotonic() - began >= 20 * DT_S - 0.005 and arm.tick == 20
