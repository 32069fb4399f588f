"""Files of demonstrations: actions against the environment's actions; each planted mistake by name."""

import dataclasses

import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.logs.checks import LogError
from mjx_softarm.logs.schema import Log, write_log
from mjx_softarm.sensing.pose import frame_from_pose
from train.demos.demonstrations import NEEDED, load_demonstrations, read_demonstrations, shown_before

SPEC = ArmSpec.default()
SEQUENCE = np.array([0, 0, 0, 5, 2, 2])


def demonstration_log(**changes):
    rng = np.random.default_rng(0)
    spring_m = rng.uniform(0.12, 0.22, (6, 9))
    values = {
        "time_s": np.array([0.0, 3.0, 8.0, 2.0, 9.0, 9.5]),  # the fourth row was another recording
        "readings": SPEC.spring_sensor.readings(spring_m),
        "spring_m": spring_m,
        "tip_m": rng.uniform([-0.1, -0.1, -0.6], [0.1, 0.1, -0.5], (6, 3)),
        "tip_quaternion": np.tile([np.cos(0.1), 0.0, np.sin(0.1), 0.0], (6, 1)),
        "sequence": SEQUENCE,
    }
    return Log(source="demos", row=np.arange(6) + 2, **(values | changes))


@pytest.fixture
def file(tmp_path):
    """Writes a log with changes: group -> (row, column, value)."""

    def write(name="demos.csv", without=(), **changes):
        values = {group: np.array(getattr(demonstration_log(), group), float) for group in changes}
        for group, (row, column, value) in changes.items():
            values[group].reshape(6, -1)[row, column] = value
        log = dataclasses.replace(demonstration_log(**values), **dict.fromkeys(without))
        write_log(tmp_path / name, log)
        return tmp_path / name

    return write


@pytest.mark.parametrize("name", ["demos.csv", "demos.npz"])
def test_rows_are_positions_and_the_actions_that_lead_there(file, env, name):
    log, demos = demonstration_log(), load_demonstrations(file(name), SPEC)
    np.testing.assert_array_equal(demos.sequence, SEQUENCE)
    assert demos.positions.dtype == demos.actions.dtype == np.float32
    # The action is the one with which the environment asks for these springs, and with which it gets them.
    np.testing.assert_allclose(demos.actions, env.action_of(log.spring_m.astype(np.float32)), atol=2e-5)
    np.testing.assert_allclose(env.reference_m(demos.actions), log.spring_m, atol=1e-6)
    position_m, rotation = frame_from_pose(demos.positions.astype(float))
    np.testing.assert_allclose(position_m, log.tip_m, atol=1e-7)
    turn = [[np.cos(0.2), 0, np.sin(0.2)], [0, 1, 0], [-np.sin(0.2), 0, np.cos(0.2)]]  # 0.2 rad about y
    np.testing.assert_allclose(rotation, np.tile(turn, (6, 1, 1)), atol=1e-6)


LOW = SPEC.spring_sensor.readings(np.full(9, SPEC.springs.length_min_m))[0]
MISTAKES = {
    "NaN": ("readings", (4, 3, np.nan), "line 6: frequency3: got nan, expected a number"),
    "no orientation": ("tip_quaternion", (1, 2, np.nan), "line 3: tip_qy: got nan, expected a number"),
    "short": ("readings", (0, 8, LOW - 10), f"line 2: frequency8: got {LOW - 10:.7g} Hz, expected {LOW:.7g}"),
    "m for mm": ("tip_m", (2, 2, -600.0), "line 4: tip_x..z: got "),
    "above the base": ("tip_m", (2, 2, 0.3), "a tip below the base and within 825 mm of it"),
    "no rotation": ("tip_quaternion", (3, 0, 0.5), "line 5: tip_qw..qz: got length 0.5099, expected unit"),
    "no id": ("sequence", (1, 0, 0.5), "line 3: sequence: got 0.5, expected a whole number from 0"),
    "back in time": ("time_s", (1, 0, 8.5), "line 4: time: got 8 s after 8.5 s, expected time's order"),
    "in two pieces": ("sequence", (5, 0, 0), "line 7: sequence: got 0 again after 2, expected a sequence in"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_planted_mistake_is_named(file, mistake, name="demos.csv"):
    group, change, message = MISTAKES[mistake]
    path = file(name, **{group: change})
    with pytest.raises(LogError) as error:
        load_demonstrations(path, SPEC)
    assert len(error.value.findings) == 1
    assert str(error.value).startswith(f"{path}: line ") and message in str(error.value)


@pytest.mark.parametrize("group", NEEDED)
def test_missing_columns(file, group):
    with pytest.raises(LogError, match=r"demos.csv: line 1: .*: got nothing, expected"):
        load_demonstrations(file(without=[group]), SPEC)


def test_every_mistake_has_a_line(file):
    with pytest.raises(LogError) as error:
        load_demonstrations(file(readings=(2, 0, 0.0), tip_m=(4, 2, 0.3)), SPEC)
    assert [finding.rows for finding in error.value.findings] == [(4, 4), (6, 6)]


def test_unknown_columns_are_told(file):
    path = file()
    header, *rows = path.read_text().splitlines()
    path.write_text("\n".join([f"{header},colour [1]", *(f"{row},0" for row in rows)]))
    log, extra = read_demonstrations(path, SPEC)
    assert len(log) == 6 and [finding.column for finding in extra] == ["colour"]


def test_the_position_shown_before_is_of_the_same_sequence():
    np.testing.assert_array_equal(shown_before(np.array([4, 4, 4, 0, 0, 7])), [0, 0, 1, 3, 3, 5])
