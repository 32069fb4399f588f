"""The example drivers with a microcontroller of the test's own at the other end of a real line."""

import os
import pty
import threading
import tty

import numpy as np
import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.drivers import serial_line
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.deploy.drivers.serial_line import SerialArm
from tests.arms import SIX_CHAMBERS
from tests.linear_arm import SPEC, LinearArm, N

TIMEOUT_S = 0.5  # this machine may be busy


class Controller:
    """A linear arm's microcontroller: answers lines by the table of `mjx_softarm.deploy.drivers`."""

    def __init__(self):
        self.arm, self.late, self.silent, self.garbage = LinearArm(), b"", 0, b""

    def answers(self, line):
        letter, count, *values = line.decode("ascii").split()
        if self.silent:
            self.silent -= 1
            self.late = f"R {count} {' '.join(['1'] * 18)}\n".encode()
            return []
        late, self.late = self.late, b""
        if self.garbage:
            return [self.garbage.replace(b"K", count.encode())]
        if letter == "R":
            words = [f"{value:.9g}" for value in (*self.arm.read_sensors(), *self.arm.actual_kpa)]
            return [late, f"R {count} {' '.join(words)}\n".encode()]
        if max(map(float, values)) > 20.0:
            return [f"E {count} chamber beyond 20 kPa\n".encode()]
        self.arm.write_pressures(np.array(values, float))
        return [late, f"P {count}\n".encode()]


@pytest.fixture
def driven():
    """The driver's class, and the microcontroller at the other end of its line."""
    pytest.importorskip("serial")
    controller = Controller()
    ours, theirs = pty.openpty()
    tty.setraw(theirs)

    def loop():
        pending = b""
        while True:
            *lines, pending = (pending + os.read(ours, 4096)).split(b"\n")
            for line in lines:
                if line == b"end":
                    return
                for answer in controller.answers(line):
                    os.write(ours, answer[: len(answer) // 2])  # in two parts, as they come over a wire
                    os.write(ours, answer[len(answer) // 2 :])

    thread = threading.Thread(target=loop)
    thread.start()
    yield type("Arm", (SerialArm,), {"port": os.ttyname(theirs), "n": N, "timeout_s": TIMEOUT_S}), controller
    os.write(theirs, b"end\n")
    thread.join()
    os.close(ours)
    os.close(theirs)


@pytest.fixture
def line(driven):
    return driven[0](), driven[1]


@pytest.mark.parametrize(("spec", "n_springs"), [(SPEC, 0), (SIX_CHAMBERS, 9)])
def test_values_go_over_the_line(spec, n_springs, line):
    """There may be fewer springs than chambers."""
    arm, controller = line
    controller.arm, arm.n, arm.n_springs = LinearArm(noise_m=0.0, spec=spec), spec.n_chambers, n_springs
    kpa = np.linspace(-40.0, 20.0, spec.n_chambers)
    for _ in range(3):
        arm.write_pressures(kpa)
        np.testing.assert_allclose(controller.arm.command_kpa, kpa, rtol=1e-5)
        np.testing.assert_allclose(arm.read_sensors(), controller.arm.read_sensors(), rtol=1e-8)
        np.testing.assert_allclose(arm.pressures(), controller.arm.actual_kpa, rtol=1e-8)


def test_old_answers_are_passed_over(line):
    arm, controller = line
    arm.timeout_s, controller.silent = 0.05, 1
    with pytest.raises(TimeoutError, match="R: got no answer, expected one within 50 ms"):
        arm.read_sensors()
    assert np.isnan(arm.pressures()).all()  # those measured before are old
    arm.timeout_s = TIMEOUT_S
    assert arm.read_sensors().min() > 1e6  # the late answer had ones


def test_what_the_arm_refuses_is_an_error_and_what_it_garbles_is_lost(line):
    arm, controller = line
    with pytest.raises(ValueError, match="P: got the refusal 'chamber beyond 20 kPa'"):
        arm.write_pressures(np.full(N, 21.0))
    arm.timeout_s = 0.05
    nine = b" 1 2 3 4 5 6 7 8 9"
    for garbage, message in (
        (b"R K 1 2 3\n", "got 'R' and 3 numbers, expected 'R' and 18"),
        (b"R K 1 2 x3\n", "'1 2 x3', expected numbers"),
        (b"P K" + 2 * nine + b"\n", "got 'P' and 18 numbers, expected 'R' and 18"),
        (b"\n\n\xff R\n", "got no answer, expected one within 50 ms"),
        # Its end is missing: the last number may be 98.7
        (b"R K" + 2 * nine, "got no answer, expected one within 50 ms"),
    ):
        controller.garbage = garbage
        with pytest.raises(TimeoutError, match=message):
            arm.read_sensors()
    arm.timeout_s, controller.garbage = TIMEOUT_S, b""
    with pytest.raises(TimeoutError):  # this answer hangs on to the one without an end
        arm.read_sensors()
    assert arm.read_sensors().min() > 1e6


def test_board_that_begins_anew_is_waited_for(driven, monkeypatch):
    kind, controller = driven
    kind.timeout_s, controller.silent = 0.05, 4
    assert kind().read_sensors().min() > 1e6 and controller.silent == 0
    monkeypatch.setattr(serial_line, "START_S", 0.2)
    controller.silent = 100
    with pytest.raises(OSError, match=r"/dev/.*: got no readings, expected some within 0.2 s; R: got no"):
        kind()


def test_line_that_cannot_be_sent_in_time_is_lost(monkeypatch):
    pytest.importorskip("serial")
    ends = (_, theirs) = pty.openpty()  # nobody reads at the other
    tty.setraw(theirs)
    monkeypatch.setattr(SerialArm, "_wait_for_answer", lambda _: None)
    arm = type("Arm", (SerialArm,), {"port": os.ttyname(theirs), "n": N, "timeout_s": 0.02})()
    with pytest.raises(TimeoutError, match="got a line stuck, expected it sent within 20 ms"):
        arm.send(1_000_000 * b"?")
    for end in ends:
        os.close(end)


def test_an_arm_by_its_settings(driven, tmp_path):
    file = tmp_path / "wiring.toml"
    file.write_text(f"[arm]\ndriver = 'serial'\nport = '{driven[0].port}'\nn = {N}\ntimeout_s = 0.5\n")
    arm = open_arm(str(file))
    assert arm.read_sensors().min() > 1e6 and len(arm.pressures()) == N


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[arm", "expected a TOML file"),
        ("[springs]", "got .*springs.*, expected the table arm"),
        ("[arm]\ndriver = 'serial'\nsend = 1", "got send, expected some of port, "),
        ("[arm]\ndriver = 'serial'\nport = '/dev/ttyNONE'", "got SerialException: .*/dev/ttyNONE"),
    ],
)
def test_files_that_wire_nothing(text, message, tmp_path):
    pytest.importorskip("serial")
    (tmp_path / "wiring.toml").write_text(text)
    with pytest.raises(InputError, match=message):
        open_arm(str(tmp_path / "wiring.toml"))
