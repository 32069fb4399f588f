"""The firmware, compiled for the host against stand-ins of Wire and Serial, behind the real driver."""

import os
import pty
import shutil
import subprocess
import time
import tty
from pathlib import Path

import numpy as np
import pytest

from mjx_softarm.__main__ import main
from mjx_softarm.deploy.drivers.serial_line import SerialArm

FIRMWARE = Path(__file__).resolve().parents[3] / "mjx_softarm/deploy/drivers/firmware/firmware.ino"
BOARD = Path(__file__).parent / "board"
STRICT = ("-std=c++11", "-O1", "-Wall", "-Wextra", "-Werror")  # C++11 as the oldest boards' compilers
SPEED = 4.0  # of the board's time
HZ = 2e6 + 0.3e6 * np.arange(9)

pytestmark = pytest.mark.skipif(not shutil.which("g++"), reason="there is no compiler g++ here")


def built(folder, firmware, name="board"):
    command = ["g++", *STRICT, "-I", str(BOARD), "-I", str(firmware.parent), str(BOARD / "board.cpp")]
    done = subprocess.run([*command, "-o", str(folder / name)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / name


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return built(tmp_path_factory.mktemp("board"), FIRMWARE)


@pytest.fixture
def board(program, request):
    """The driver of a board that runs, and a function that changes the board's hardware."""
    pytest.importorskip("serial")
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    process = subprocess.Popen(
        [program, str(ours), str(SPEED)],
        pass_fds=[ours],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    arm = type("Arm", (SerialArm,), {"port": os.ttyname(theirs), "n": 9, "timeout_s": 5.0})()

    def end():
        arm._serial.close()
        process.stdin.close()
        process.stdout.close()
        status = process.wait(timeout=10)
        os.close(ours)
        os.close(theirs)
        assert status == 0  # what the board's hardware expects was done

    def change(*words):
        print(*words, file=process.stdin, flush=True)
        return float(process.stdout.readline()) if words[0] in ("time", "kpa") else None

    request.addfinalizer(end)
    return arm, change


def readings(arm, tries=50):
    """Readings once each converter has ended a conversion since the last call."""
    for _ in range(tries):
        time.sleep(0.02)
        if np.isfinite(found := arm.read_sensors()).all():
            return found
    raise AssertionError(found)


def settled(arm, kpa, tolerance_kpa=0.5, tries=400):
    for _ in range(tries):
        arm.read_sensors()
        if np.abs(arm.pressures() - kpa).max() < tolerance_kpa:
            return
        arm.write_pressures(kpa)
    raise AssertionError(arm.pressures())


def test_springs_are_read_and_pressures_are_held(board):
    arm, _ = board
    np.testing.assert_allclose(readings(arm), HZ, atol=0.6)
    kpa = np.array([-40.0, -10.0, 0.0, 5.0, 20.0, -1.0, 1.0, 12.0, -33.0])
    settled(arm, kpa)
    for _ in range(20):
        arm.write_pressures(kpa)
        arm.read_sensors()
        np.testing.assert_allclose(arm.pressures(), kpa, atol=1.5)


def test_a_silent_computer_is_followed_by_a_ramp_to_zero(board):
    arm, change = board
    settled(arm, np.full(9, -30.0))
    # The last command is heard between these times: an answer shows that the line before it was read
    earliest_s = change("time")
    arm.write_pressures(np.full(9, -30.0))
    arm.read_sensors()
    latest_s = change("time")
    # Each pressure is told between two times; reading alone does not keep the pressures
    times_s, found = [latest_s], []
    while times_s[-1] < latest_s + 3.5:
        arm.read_sensors()
        found.append(arm.pressures().mean())
        times_s.append(change("time"))
    before_s, after_s = np.array(times_s[:-1]) - latest_s, np.array(times_s[1:]) - earliest_s
    ramp = [1.0, 2.5], [-30.0, 0.0]  # 20 kPa/s, as the computer vents
    assert (np.array(found) > np.interp(before_s, *ramp) - 2.0).all()
    assert (np.array(found) < np.interp(after_s, *ramp) + 2.0).all()
    settled(arm, np.full(9, 5.0))  # and the computer may come back


def test_coils_that_cannot_be_read_are_nan_and_leave_the_others(board):
    arm, change = board
    readings(arm)
    change("gone", 0, 0x2A)
    change("flag", 1, 0x2B, 4)
    change("reset", 2, 0x2A)
    time.sleep(0.1)
    arm.read_sensors()
    time.sleep(0.05)
    found = arm.read_sensors()
    np.testing.assert_array_equal(np.isnan(found), np.isin(np.arange(9), [0, 1, 5, 6, 7]))
    np.testing.assert_allclose(found[[2, 3, 4, 8]], HZ[[2, 3, 4, 8]], atol=0.6)


def test_a_leaking_chamber_shows_in_the_measured_pressures(board):
    arm, change = board
    settled(arm, np.full(9, 10.0))
    change("leak", 3)
    for _ in range(20):
        arm.write_pressures(np.full(9, 10.0))
        arm.read_sensors()
    off = np.abs(arm.pressures() - 10.0)
    assert off[3] > 3.0 and np.delete(off, 3).max() < 1.5


@pytest.mark.parametrize("count", [9, 4090])
def test_a_chamber_whose_sensor_s_wire_is_cut_is_closed(count, board):
    arm, change = board
    settled(arm, np.full(9, 10.0))
    change("wire", 3, count)
    before_kpa, began_s = change("kpa", 3), change("time")
    while change("time") - began_s < 1.0:
        arm.write_pressures(np.full(9, 15.0))
        arm.read_sensors()
    assert change("kpa", 3) == pytest.approx(before_kpa, abs=0.5)
    np.testing.assert_allclose(np.delete(arm.pressures(), 3), 15.0, atol=1.5)


def test_a_sensor_that_reads_above_the_limits_lets_no_supply_in(board):
    arm, change = board
    settled(arm, np.full(9, 10.0))
    change("wire", 3, 3000)  # 46.5 kPa
    time.sleep(0.1)
    assert change("kpa", 3) < 10.5


@pytest.mark.parametrize(
    ("kpa", "why"),
    [
        (np.full(9, 20.5), "pressure beyond the limits"),
        (np.full(9, np.nan), "pressure beyond the limits"),
        (np.zeros(8), "expected as many numbers as chambers"),
    ],
)
def test_what_the_firmware_refuses(kpa, why, board):
    arm, _ = board
    settled(arm, np.full(9, 8.0))
    with pytest.raises(ValueError, match=f"P: got the refusal '{why}'"):
        SerialArm.write_pressures(arm, kpa)
    arm.read_sensors()
    np.testing.assert_allclose(arm.pressures(), 8.0, atol=1.5)


def test_noise_on_the_line_is_answered_once_and_passed_over(board):
    arm, _ = board
    for noise in (b"\n", b"R\n", b"X 1\n", b"R x\n", b"P 1 1 2 x\n", b"R " + 600 * b"9" + b"\n", b"\xff\n"):
        arm.send(noise)
    assert len(readings(arm)) == 9
    arm.write_pressures(np.zeros(9))


def test_the_command_writes_the_firmware_of_an_arm(program, tmp_path, capsys):
    assert main(["firmware", "--out", str(tmp_path / "paper")]) == 0
    assert (tmp_path / "paper" / "paper.ino").read_text() == FIRMWARE.read_text()
    assert main(["firmware", "--out", str(tmp_path / "paper")]) == 2
    assert main(["firmware", "--spec", "sopra", "--out", str(tmp_path / "firmware")]) == 0
    made = (tmp_path / "firmware" / "firmware.ino").read_text()
    for line in (
        "int N_SPRINGS = 6;",
        "int N_CHAMBERS = 6;",
        "float MIN_KPA = 0.0f;",
        "float MAX_KPA = 60.0f;",
    ):
        assert f"constexpr {line}" in made
    # Until the pins are those of the arm, the sketch does not compile.
    with pytest.raises(AssertionError, match="FILL_PIN: expected one for each chamber"):
        built(tmp_path, tmp_path / "firmware" / "firmware.ino")
    capsys.readouterr()
