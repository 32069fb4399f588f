"""Demonstrations that are taken from a steered arm, checked as they are taken."""

import dataclasses
import re

import numpy as np
import pytest

from mjx_softarm.deploy.loop import start
from mjx_softarm.logs.schema import write_log
from mjx_softarm.view.live import TakenPoses
from tests.linear_arm import CONTROLLER, HIGH_KPA, POLICY, REST_M, SENSOR, SPEC, N
from train.demos.demonstrations import load_demonstrations

POSE = np.array([20.0, -10.0, -600.0, 0.0, 5.0, 0.0])


def held(window_m=REST_M, lost=False, goal=None, **command):
    """A state of the loop that holds its springs."""
    state, spring_m = start(CONTROLLER), np.full(N, REST_M)
    window_m = np.full((CONTROLLER.window, N), window_m)
    belief = dataclasses.replace(
        state.belief, spring_m=spring_m, window_m=window_m, n_lost=np.zeros(N, int) + lost
    )
    command = state.command._replace(**({"reference_m": spring_m} | command))
    return state._replace(belief=belief, command=command, goal=goal)


HOLDS = held()
SATURATED = held(pressure_kpa=HIGH_KPA * np.eye(N)[2], reference_m=REST_M + 0.01 * np.eye(N)[2])
READINGS = SENSOR.readings(np.full(N, REST_M))


def row(time_s, pose=POSE, **others):
    return {"time_s": time_s, "readings": READINGS, "estimate": pose} | others


def test_poses_are_what_imitation_takes(tmp_path):
    demos = TakenPoses(POLICY)
    assert demos.take(HOLDS, row(1.0)) == "pose 1 taken: tip at 20, -10, -600 mm, estimated"
    assert "expected another" in demos.take(HOLDS, row(2.0, POSE + 0.5))
    seen = {"tip_m": np.array([0.0, 0.03, -0.6]), "tip_quaternion": np.array([1.0, 0.0, 0.0, 0.0])}
    assert demos.take(HOLDS, row(3.0, **seen)).endswith("tip at 0, 30, -600 mm, measured")
    missed = {"tip_m": np.full(3, np.nan), "tip_quaternion": np.full(4, np.nan)}
    assert demos.take(HOLDS, row(4.0, **missed)).endswith("estimated")
    write_log(tmp_path / "demos.csv", demos.log())
    found = load_demonstrations(tmp_path / "demos.csv", SPEC)
    np.testing.assert_allclose(found.positions, [POSE, [0, 30, -600, 0, 0, 0], POSE], atol=1e-3)
    np.testing.assert_allclose(
        found.actions, POLICY.actions.from_readings(np.tile(READINGS, (3, 1))), atol=1e-4
    )
    assert not found.sequence.any()


@pytest.mark.parametrize(
    ("state", "others", "message"),
    [
        (held(reference_m=None), {}, "has no pressure, expected one at rest"),
        (held(goal=POSE), {}, "an arm that moves"),
        (held(window_m=np.linspace(0.2, 0.21, 25)[:, None]), {}, "an arm that moves"),
        (held(lost=np.eye(N, dtype=bool)[4]), {}, "spring 4: got no reading"),
        (SATURATED, {}, "chamber 2: got its limit of pressure"),
        (HOLDS, {"readings": SENSOR.readings(np.full(N, 0.3))}, "spring 0: got .* range of actions"),
    ],
)
def test_poses_that_cannot_be_learned_from_are_refused(state, others, message):
    demos = TakenPoses(POLICY)
    assert re.search(f"pose not taken: .*{message}", demos.take(state, row(1.0, **others)))
    assert len(demos) == 0
