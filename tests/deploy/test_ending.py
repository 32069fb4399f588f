"""Faults injected at every call of a driver: the arm is vented, its rows are kept, the cause is named."""

import signal

import numpy as np
import pytest

from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.ending import save_log
from mjx_softarm.deploy.link import VENT_TRIES
from mjx_softarm.deploy.record import record
from mjx_softarm.mechanics.excitation import random_pressures
from tests.linear_arm import GOALS, POLICY, SPEC, LinearArm, N, go

METHODS = ("time_s", "read_sensors", "write_pressures", "pressures", "motion_capture")
TARGETS_KPA = random_pressures(SPEC, 1, 0)


class Faulty:
    """A linear arm with all methods, of which some calls, counted from 0, raise or give something else."""

    def __init__(self, fault, method=None, calls=range(0)):
        self.arm, self._fault, self._method, self._calls = LinearArm(), fault, method, calls
        self.n_calls, self.n_of = 0, dict.fromkeys(METHODS, 0)
        self.failed = ""  # method of the first fault
        self.n_rows = 0  # ticks that were whole before it

    def _called(self, method, answer):
        count = self.n_calls if self._method is None else self.n_of[method]
        self.n_calls, self.n_of[method] = self.n_calls + 1, self.n_of[method] + 1
        if self._method in (None, method) and count in self._calls:
            if not self.failed:
                self.failed, self.n_rows = method, len(self.arm.written)
            value = self._fault()
            return value if method != "motion_capture" else Capture(*[value] * 4)
        return answer()

    @property
    def time_s(self):
        return self._called("time_s", lambda: self.arm.time_s)

    def read_sensors(self):
        return self._called("read_sensors", self.arm.read_sensors)

    def write_pressures(self, pressure_kpa):
        assert np.isfinite(pressure_kpa).all()
        self._called("write_pressures", lambda: self.arm.write_pressures(pressure_kpa))

    def pressures(self):
        return self._called("pressures", lambda: self.arm.actual_kpa)

    def motion_capture(self):
        position_m = self.arm.spring_m[:3]
        seen = Capture(position_m, np.array([1.0, 0.0, 0.0, 0.0]), position_m[None], self.arm.spring_m)
        return self._called("motion_capture", lambda: seen)


class Mute(Exception):
    """An error without a text."""

    def __str__(self):
        raise TypeError("no text")


def raises(error):
    def fault():
        raise error

    return fault


def drive(command, arm, **kwargs):
    """Run or record; its ending, log, and the logs that were saved."""
    saved, tell = [], kwargs.pop("tell", lambda text: None)
    if command == "run":
        run = go(arm, goals=GOALS[:1], duration_s=0.6, tell=tell, save=saved.append)
        return run.ending, run.log, saved
    recording = record(arm, SPEC, TARGETS_KPA, tell, saved.append)
    return recording.ending, recording.log, saved


def vented(arm):
    return not arm.arm.command_kpa.any()


@pytest.mark.parametrize("command", ["run", "record"])
def test_fault_at_every_call_vents_and_keeps_the_rows(command):
    whole = Faulty(None)
    assert drive(command, whole)[0] == ("", 0, True)
    n_before_vent = whole.n_calls - 20
    calls = range(1, n_before_vent, 1 if command == "run" else 29)
    assert len(calls) > 20
    for call in calls:
        lines = []
        arm = Faulty(raises(RuntimeError("valve driver")), calls=range(call, call + 1))
        ending, log, saved = drive(command, arm, tell=lines.append)
        if arm.failed == "write_pressures" and ending.status == 0:  # in the venting, which tries again
            assert vented(arm) and ending.vented and ending.cause == ""
            continue
        assert vented(arm) and ending.vented and ending.status == 3, call
        assert f"{arm.failed}: RuntimeError: valve driver" in ending.cause
        assert any(arm.failed in line and "-> vented" in line for line in lines)
        assert len(log) >= arm.n_rows and (not len(log) or len(saved[0]) == len(log))


@pytest.mark.parametrize("command", ["run", "record"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (OSError("bus error"), "bus error"),
        (ValueError("beyond 20 kPa"), "beyond 20 kPa"),
        (SystemExit(1), "1"),
        (Mute(), "Mute"),
        (KeyboardInterrupt(), "interrupted"),
    ],
)
def test_every_error_of_every_method(command, method, error, cause):
    arm = Faulty(raises(error), method, range(20, 21))
    ending, log, saved = drive(command, arm)
    assert vented(arm) and ending.vented and len(saved[0]) == len(log)
    if method == "motion_capture" and isinstance(error, OSError):  # a missed frame is a gap
        assert ending == ("", 0, True)
        assert np.isnan(log.tip_m).all(axis=1).nonzero()[0].tolist() == [20]
        assert np.isnan(log.marker_m[20]).all() and np.isfinite(log.pressure_kpa).all()
        return
    status = 130 if isinstance(error, KeyboardInterrupt) else 3
    assert ending.status == status and (ending.cause == cause if status == 130 else cause in ending.cause)
    assert arm.n_rows <= len(log) <= arm.n_rows + 1


@pytest.mark.parametrize("method", ["time_s", "pressures"])
def test_a_timeout_is_named_where_the_loop_cannot_go_on(method):
    arm = Faulty(raises(TimeoutError("bus")), method, range(20, 21))
    ending = drive("run", arm)[0]
    assert vented(arm) and ending.status == 3 and ending.cause == f"{method}: bus"


def test_a_frame_that_is_no_capture_is_named():
    class Bare(LinearArm):
        def motion_capture(self):
            return np.zeros(7)

    arm = Bare()
    run = go(arm, goals=GOALS[:1])
    assert run.status == 3 and not arm.command_kpa.any()
    assert run.ending.cause == "motion_capture: got ndarray, expected mjx_softarm.deploy.arm_io.Capture"


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("value", [np.full(N, np.nan), np.zeros(5), "text", None])
def test_impossible_values(method, value):
    arm = Faulty(lambda: value, method, range(20, 40))
    ending, log, saved = drive("run", arm)
    assert vented(arm) and len(saved[0]) == len(log) >= arm.n_rows
    gap = (method == "motion_capture" and value is None) or (method == "pressures" and np.size(value) == N)
    harmless = method == "write_pressures" or gap
    assert ending.status == (0 if harmless else 3)
    assert harmless or method in ending.cause or "sensor lost" in ending.cause


def test_plan_that_is_not_finite_is_never_written():
    arm = Faulty(None)
    run = go(arm, controller=Controller.of(POLICY, lambda *_: np.full(N, np.nan)))
    assert run.status == 3 and "expected finite numbers" in run.ending.cause and vented(arm)


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
@pytest.mark.parametrize("command", ["run", "record"])
def test_signals_vent_and_save(command, name, request):
    """Sent in the drive, and again in the venting, where they change nothing."""
    number = getattr(signal, name)
    # A program that was started in the background may have been told to ignore SIGINT.
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, ours))
    before = signal.getsignal(number)
    calls = range(20, 21) if number == signal.SIGINT else (20, 25)

    def send():
        signal.raise_signal(number)
        raise TimeoutError

    arm = Faulty(send, "write_pressures", calls)
    ending, log, saved = drive(command, arm)
    assert vented(arm) and ending.vented and ending.status == 128 + number
    assert len(saved[0]) == len(log) == 21
    assert signal.getsignal(number) == before


def test_signals_that_come_together_vent_and_save():
    both = {signal.SIGTERM, signal.SIGHUP}

    def send():
        signal.pthread_sigmask(signal.SIG_BLOCK, both)
        for number in both:
            signal.raise_signal(number)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, both)

    arm = Faulty(send, "write_pressures", (20,))
    ending, log, saved = drive("run", arm)
    assert vented(arm) and ending.vented and ending.status - 128 in both
    assert len(saved[0]) == len(log) == 21


def test_second_interrupt_ends_the_venting_at_once_and_says_so():
    lines = []
    arm = Faulty(raises(KeyboardInterrupt()), "write_pressures", (20, 25))
    ending, log, saved = drive("run", arm, tell=lines.append)
    assert ending.status == 130 and not ending.vented and not vented(arm)
    assert arm.n_of["write_pressures"] == 26
    assert "MAY BE UNDER PRESSURE" in ending.cause and "MAY BE UNDER PRESSURE" in lines[-1]
    assert len(saved[0]) == len(log) == 21


def test_interrupt_in_the_venting_alone_changes_nothing():
    n_ticks = len(drive("run", Faulty(None))[1])
    arm = Faulty(raises(KeyboardInterrupt()), "write_pressures", (n_ticks + 3,))
    ending, _, saved = drive("run", arm)
    assert vented(arm) and ending == ("interrupted", 130, True) and len(saved[0]) == n_ticks


@pytest.mark.parametrize("error", [OSError("pump"), TimeoutError(), ValueError("no")])
def test_venting_is_tried_again(error):
    n_ticks = len(drive("run", Faulty(None))[1])
    arm = Faulty(raises(error), "write_pressures", range(n_ticks + 2, n_ticks + 1 + VENT_TRIES))
    assert drive("run", arm)[0] == ("", 0, True) and vented(arm)
    lines = []
    dead = Faulty(raises(error), "write_pressures", range(n_ticks + 2, 10**6))
    ending, log, saved = drive("run", dead, tell=lines.append)
    assert ending.status == 3 and not ending.vented and "MAY BE UNDER PRESSURE" in lines[-1]
    assert len(saved[0]) == len(log) == n_ticks and dead.n_of["write_pressures"] == n_ticks + 2 + VENT_TRIES


def test_what_tell_and_arrived_raise_vents():
    def full(_):
        raise OSError("no space left on device")

    arm = Faulty(None)
    run = go(arm, goals=GOALS, arrived=full)
    assert run.status == 3 and "no space left" in run.ending.cause and vented(arm) and len(run.arrivals) == 1
    arm = Faulty(None)
    assert go(arm, tell=full).ending == ("no space left on device", 3, True) and vented(arm)


def test_log_that_cannot_be_written_goes_elsewhere(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    arm = Faulty(None)
    run = go(arm, duration_s=0.6, save=lambda log: save_log(tmp_path / "gone" / "a.csv", log))
    assert run.status == 2 and run.ending.vented and vented(arm)
    [spare] = tmp_path.glob("*/a.csv")
    assert str(spare) in run.ending.cause and spare.read_text().count("\n") == len(run.log) + 1
