"""The twin's circle, driven by the C++ program through a pipe, beside NumPy's loop."""

import dataclasses
import shutil
import subprocess

import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.deploy.session import follow
from mjx_softarm.export.cpp import sources
from mjx_softarm.mechanics.excitation import circle_poses
from tests.export.conftest import busy_policy
from tests.linear_arm import N


@pytest.mark.slow  # a minute of an arm, twice
@pytest.mark.skipif(not shutil.which("g++"), reason="there is no compiler g++ here")
def test_circle_ends_where_numpy_s_ends(tmp_path):
    around = circle_poses(ArmSpec.default(), 2000)
    policy = dataclasses.replace(busy_policy(), workspace=around, n_actions=2, s2r=None)
    controller, goals = Controller.of(policy), around[::500].astype(float)
    run = follow(open_arm("twin:0"), controller, goals)
    assert len(run.arrivals) == len(goals)
    expected_m = run.log.tip_m[[arrival.row for arrival in run.arrivals]]

    for name, text in sources(controller, "ab").items():
        (tmp_path / name).write_text(text)
    subprocess.run(["g++", "-std=c++17", "-O2", tmp_path / "rows.cpp", "-o", tmp_path / "rows"], check=True)
    arm, tips_m = open_arm("twin:0"), []
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "bufsize": 1}
    with subprocess.Popen([tmp_path / "rows"], **pipes) as program:
        assert program.stdout.readline().split() == ["mjx_softarm", "2", "ab"]
        for goal in goals:
            new, arrived = 1, False
            while not arrived:
                readings, _, seen = arm.read_sensors(), arm.pressures(), arm.motion_capture()
                row = (int(not tips_m and new), new, 0, 1, 0, 0, *readings, *goal)
                print(*(f"{value:.17g}" for value in row), file=program.stdin)
                _, arrived, *kpa = np.array(program.stdout.readline().split(), float)[: 2 + N]
                arm.write_pressures(np.array(kpa))
                new = 0
            tips_m.append(seen.tip_m)
        program.stdin.close()
    assert np.ptp(expected_m, axis=0).max() > 1e-3  # it moved
    np.testing.assert_allclose(tips_m, expected_m, rtol=0, atol=1e-6)
