"""Each change that the page "Extend" prints, applied to a copy and used."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calib.arm import CalibratedArm
from tests.arms import SHORT
from tests.train.small import CONFIG, flags
from train.runs.folder import Run

ROOT = Path(__file__).resolve().parents[2]
PARTS = dict(
    re.findall(r"^## (.+?)\n(.+?)(?=^## |\Z)", (ROOT / "docs/extend.md").read_text("utf-8"), re.M | re.S)
)


def block(part, language):
    return re.search(rf"```{language}\n(.+?)```", PARTS[part], re.S)[1]


@pytest.fixture
def changed(tmp_path):
    """Make a copy of the code with the part's diff applied."""

    def make(part):
        for room in ("mjx_softarm", "train", "calib", "benchmarks"):
            shutil.copytree(ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("__pycache__"))
        subprocess.run(["git", "apply", "-"], cwd=tmp_path, input=block(part, "diff"), text=True, check=True)
        return tmp_path

    return make


def output(folder, *arguments):
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout


def test_a_reward_term(changed):
    program = """
import numpy as np
from mjx_softarm.mdp.rewards import RewardConfig, reward
goal = np.array([0.0, 0.0, -600.0, 0.0, 0.0, 0.0])
pose = goal + [30.0, 0.0, 0.0, 0.0, 20.0, 0.0]
both = [reward(at, goal, 0, np.array(False), RewardConfig())[2]["pitch"].item() for at in (pose, goal)]
print(*both)
"""
    away, there = map(float, output(changed("A reward term"), "-c", program).split())
    assert (away, there) == (pytest.approx(-2.0), 0.0)


def test_a_sensor(changed):
    folder = changed("A sensor")
    (folder / "sensor.toml").write_text(block("A sensor", "toml"))
    program = """
import tomllib
import numpy as np
from mjx_softarm import ArmSpec
from mjx_softarm.mdp.actions import ActionMap
from mjx_softarm.sensing.sensors import Sensor
from mjx_softarm.twin.arm import Twin
data = ArmSpec.default().to_dict() | tomllib.load(open("sensor.toml", "rb"))
spec = ArmSpec.from_dict(data)
sensor, twin = spec.spring_sensor, Twin(0, spec)
readings = twin.read_sensors()
length_m, fault = sensor.lengths(readings)
actions = ActionMap.from_spec(spec)
back_m = actions.lengths(actions.from_lengths(length_m))
print(sensor.unit, readings.mean(), fault.any(), np.abs(back_m - length_m).max() < 1e-5)
"""
    unit, ohm, faulty, same = output(folder, "-c", program).split()
    assert (unit, faulty, same) == ("ohm", "False", "True") and 3e3 < float(ohm) < 6e3  # 1e5 * 0.2**2 = 4000


@pytest.mark.slow
def test_a_learner(changed):
    folder = changed("A learner")
    SHORT.to_toml(folder / "arm.toml")
    command = block("A learner", "sh").split()[1:]
    output(folder, *command, *flags(), "--spec=arm.toml", "--out=run")
    run = Run(folder / "run", CONFIG, CalibratedArm(SHORT))
    assert run.metrics()[-1]["env_steps"] == 256 and "evaluation/median_mm" in run.metrics()[-1]
    learner = json.loads((run.path / "config.json").read_text())["train"]["learner"]
    assert (learner["name"], learner["random_share"]) == ("restless", 0.2)


def test_tqc_swings_pendulums_up():
    page = {"__name__": "page"}
    exec(block("TQC on an environment of yours", "python"), page)
    keys = page["jax"].random.split(page["jax"].random.key(1), 8)
    policy, reward = page["train"](1500, page["jax"].random.key(0))
    before = reward[: page["EPISODE"]].sum(axis=0).mean()  # random actions for half of the episode
    after = np.mean([page["returns"](policy, key) for key in keys])  # 32 episodes: single ones differ by 300
    assert before < -700.0 and after > -400.0  # random: -1,200


def test_the_page_s_own_driver_reads_writes_and_never_returns_a_late_answer(monkeypatch):
    class Board:
        """A serial port: what was sent, and the answers to come."""

        def __init__(self, *settings, timeout):
            self.sent, self.answers = [], [b"1 2 3 4 5 6 7 8 9\n", b"1 2\n"]
            self.waiting = [b"a late answer\n"]

        def reset_input_buffer(self):
            self.waiting.clear()

        def write(self, line):
            self.sent.append(line)
            if line == b"R\n":
                self.waiting.append(self.answers.pop(0))

        def readline(self):
            return self.waiting.pop(0)

    monkeypatch.setitem(sys.modules, "serial", SimpleNamespace(Serial=Board))
    page = (ROOT / "docs/your-arm.md").read_text("utf-8")
    names = {}
    exec(re.search(r"```python\n(.+?)```", page, re.S)[1], names)
    arm = names["Arm"]()
    np.testing.assert_array_equal(arm.read_sensors(), np.arange(1.0, 10.0))
    with pytest.raises(TimeoutError):
        arm.read_sensors()
    arm.write_pressures(np.arange(-4.0, 5.0))
    assert arm.board.sent[-1] == b"P -4.00 -3.00 -2.00 -1.00 0.00 1.00 2.00 3.00 4.00\n"
