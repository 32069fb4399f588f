"""Arms by name, and the command line that drives them, without JAX in its process."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from calib.read.logs import read_log
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.__main__ import main
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.logs.rest import MIN_HOLD_S, WINDOW_S
from mjx_softarm.policy.file import save_policy
from mjx_softarm.spec import ArmSpec
from tests.linear_arm import FAR, GOALS, POLICY, REST_M, SENSOR, Blind, LinearArm, N, nan

ROOT = Path(__file__).resolve().parents[2]
FAR_AWAY = "--goal=" + ",".join(map(str, FAR))
MISSED = "--goal=" + ",".join(map(str, GOALS[0]))


@pytest.mark.parametrize(
    ("fault", "status", "message"),
    [
        ("raise RuntimeError('valve')", 3, "write_pressures: RuntimeError: valve (driver.py, line "),
        ("signal.raise_signal(signal.SIGTERM)", 143, "ended early: ended by SIGTERM"),
        ("signal.raise_signal(signal.SIGINT)", 130, "ended early: interrupted"),
    ],
)
def test_recording_that_ends_early_vents_and_has_its_log(folder, fault, status, message):
    """The driver writes each command to a file; the fault comes once, half a second after the start."""
    driver = (
        (folder / "driver.py").read_text()
        + f"""
        with open("written.txt", "a") as file:
            print(*pressure_kpa, file=file)
        if abs(self.time_s - 0.5) < 1e-6:
            {fault}
"""
    )
    (folder / "driver.py").write_text(
        "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n" + driver
    )
    done = command(folder, "record", "--arm", "driver:Arm", "--out", "a.csv", "--poses", "9")
    assert done.stdout.endswith(f"{status} []\n") and message in done.stderr
    written = np.loadtxt(folder / "written.txt")
    assert np.abs(written).max() > 3.0 and not written[-1].any()
    assert (folder / "a.csv").read_text().count("\n") == 1 + 25


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("twin", "expected twin:SEED, wiring.toml or package.module:Class"),
        ("twin:0:pipe220", "got 'pipe220', expected one of pipe300"),
        ("twin:rod:0:lost9", "got lost9, expected a chamber of this arm, lost0 to lost8"),
        ("twin:rod:0@", "got no arm"),
        ("no_such_module:Arm", "got No module named"),
        ("mjx_softarm.deploy.loop:Nothing", "got module .* has no attribute 'Nothing'"),
        ("mjx_softarm.deploy.session:LoopRun", "got no method read_sensors or write_pressures"),
    ],
)
def test_arm_that_cannot_be_had(name, message):
    with pytest.raises(InputError, match=message):
        open_arm(name)


DRIVER = """
import numpy as np

class Arm:
    time_s = 0.0
    def read_sensors(self):
        return np.full(9, {readings}) + np.random.default_rng(round(50 * self.time_s)).normal(0, 300, 9)
    def write_pressures(self, pressure_kpa):
        self.time_s += 0.02
"""
WITHOUT_JAX = """
import sys
from mjx_softarm.deploy.__main__ import main

status = main(sys.argv[1:])
loaded = sorted({name.split(".")[0] for name in sys.modules} & {"jax", "mujoco", "train", "calib"})
print(status, loaded)
"""


@pytest.fixture
def folder(tmp_path):
    readings = SENSOR.readings(np.full(N, REST_M))[0]
    (tmp_path / "driver.py").write_text(DRIVER.format(readings=readings))
    save_policy(tmp_path / "policy.npz", POLICY)
    return tmp_path


@pytest.fixture
def here(folder, monkeypatch):
    """The folder as the working one, without a module `driver` of another test."""
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "driver", raising=False)


def command(folder, *args):
    return subprocess.run(
        [sys.executable, "-c", WITHOUT_JAX, *args],
        cwd=folder,
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_command_line_runs_without_jax(folder):
    goal = "--goal=" + ",".join(map(str, POLICY.workspace[0]))
    done = command(
        folder, "run", "policy.npz", "--arm", "driver:Arm", goal, "--log", "a.csv", "--duration", "1"
    )
    assert done.stderr == "" and done.stdout.endswith("1 []\n")
    assert "from readings to pressures: median" in done.stdout
    assert "0 of 1 goals reached; the arm is vented" in done.stdout
    assert len(read_log(folder / "a.csv")[0]) > 0
    done = command(folder, "record", "--arm", "driver:Arm", "--out", "b.csv", "--poses", "2")
    assert done.stderr == "" and done.stdout.endswith("0 []\n") and "no motion capture" in done.stdout
    assert len(read_log(folder / "b.csv")[0]) > 2 * 50 * (MIN_HOLD_S + WINDOW_S)  # each tick of two holds


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("run no.npz", "no.npz: got 'No such file"),
        ("run policy.npz --log no/a.csv", "expected a file in a folder"),
        ("run policy.npz --log a.xlsx", "expected a name that ends in .csv or .npz"),
        ("run policy.npz --log policy.npz", "expected a new file"),
        ("measure policy.npz --out new --goals circel", "got circel, expected circle, grid or a CSV file"),
        ("record --out policy.npz", "expected a new file"),
        ("measure policy.npz --out .", "expected a new folder"),
        ("measure policy.npz --out new", "without the method motion_capture"),
    ],
)
def test_command_line_tells_what_is_wrong(words, message, here, capsys):
    command, *others = words.split()
    goal = ["--goal", "0,0,-600,0,0,0"] if command == "run" else []
    assert main([command, "--arm", "driver:Arm", *goal, *others]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "status", "lines"),
    [
        ("record --arm twin:7 --spec wide.toml --out a.csv --poses 1", 0, "another arm than 'wide'"),
        (f"run --arm its:Arm {FAR_AWAY}", 1, "policy: the package's own|goal outside the workspace"),
        (f"run policy.npz --arm its:Arm {MISSED}", 1, " NOT REACHED, |the policy is not calibrated"),
        (f"run --arm its:Arm {FAR_AWAY} --log a.csv", 1, "goal outside the workspace"),
        ("run --arm its:Arm --goal=0,0,-0.5,0,0,0", 1, "got 0, 0, -0.5, 0, 0, 0, expected a pose"),
        (
            *("record --arm its:Arm --out a.csv --poses 9", 3),
            "this log calibrates the springs alone|log: a.csv, 453 rows|ended early: sensors: got 3",
        ),
    ],
)
def test_lines_of_commands(words, status, lines, tmp_path, monkeypatch, capsys):
    chambers, geometry = {"pressure_max_kpa": 15.0}, {"chamber_radius_m": 0.04}
    wide = ArmSpec.default().replace(name="wide", chambers=chambers, geometry=geometry)
    wide.to_toml(tmp_path / "wide.toml")
    save_policy(tmp_path / "policy.npz", POLICY)
    monkeypatch.chdir(tmp_path)
    arm = Blind(range(450, 10**6), nan)  # it loses a sensor after 9 s
    monkeypatch.setattr("mjx_softarm.deploy.__main__.open_arm", lambda name: arm)
    assert main(words.split()) == status and not arm.command_kpa.any()
    printed = "".join(capsys.readouterr())
    assert all(line in printed for line in lines.split("|"))


@pytest.mark.parametrize(
    ("n", "reading", "message"),
    [
        (6, REST_M, "read_sensors: got 6 readings, expected 9"),
        (9, None, "got readings of 1 to 1 Hz, expected "),
        (9, 0.3, "got springs of 300 mm in the mean without pressure, expected 200 mm"),
    ],
)
def test_another_arm_than_the_policy_s_gets_no_pressure(n, reading, message, tmp_path, monkeypatch, capsys):
    class Other(LinearArm):
        def read_sensors(self):
            return np.ones(n) if reading is None else SENSOR.readings(np.full(N, reading))[:n]

        def write_pressures(self, pressure_kpa):
            raise AssertionError("pressures were written")

    save_policy(tmp_path / "policy.npz", POLICY)
    monkeypatch.setattr("mjx_softarm.deploy.__main__.open_arm", lambda name: Other())
    goal = "--goal=" + ",".join(map(str, POLICY.workspace[0]))
    assert main(["run", str(tmp_path / "policy.npz"), "--arm", "its:Arm", goal]) == 2
    assert re.search(f"error: --arm its:Arm: {message}", capsys.readouterr().err)
    status = main(["record", "--arm", "its:Arm", "--out", str(tmp_path / "a.csv"), "--poses", "1"])
    assert (status == 2) == (n != N)  # an arm that is to be calibrated may read other lengths
