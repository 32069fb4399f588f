"""Demonstrations recorded on an arm that is not where its expert believes it to be."""

import functools

import jax
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import settle_pressures
from mjx_softarm.sensing.pose import pose_from_frame, quaternion_from_pose
from mjx_softarm.sensing.s2r import S2R_FILE, save_s2r
from train.__main__ import main
from train.demos.demonstrations import read_demonstrations
from train.demos.expert import Posture
from train.demos.record import CLOSE_M, WaypointRecorder
from train.demos.waypoints import task

SPEC = ArmSpec.default()
SENSOR = SPEC.spring_sensor
DT_S, LAG = 1.0 / SPEC.control.rate_hz, 0.15  # of the way to the commanded pressure, per tick


@functools.cache
def equilibrium():
    params = ArmParams.from_spec(SPEC)
    return jax.jit(lambda pressure: settle_pressures(params, pressure))


class BlindArm:
    """The nominal arm, always at rest, its chambers filling with a lag; nobody sees it."""

    def __init__(self):
        self.time_s = 0.0
        self.pressure_kpa = np.zeros(SPEC.n_chambers)
        self.now = equilibrium()(np.float32(self.pressure_kpa))

    def read_sensors(self):
        return SENSOR.readings(np.asarray(self.now.spring_m, float))

    def write_pressures(self, pressure_kpa):
        self.pressure_kpa = self.pressure_kpa + LAG * (pressure_kpa - self.pressure_kpa)
        self.now = equilibrium()(np.float32(self.pressure_kpa))
        self.time_s += DT_S

    @property
    def finger_m(self):
        return np.asarray(self.now.tip_position_m) - 0.1 * np.asarray(self.now.tip_rotation)[:, 2]


class IdealArm(BlindArm):
    """The nominal arm, seen by motion capture."""

    def motion_capture(self):
        tip_m = np.asarray(self.now.tip_position_m, float)
        pose = pose_from_frame(tip_m, np.asarray(self.now.tip_rotation, float))
        return Capture(tip_m, quaternion_from_pose(pose), tip_m[None])


def fingers_m(log):
    """Return the finger tips (rows, 3) [m] of a log: 100 mm below the tip, along its axis."""
    x, y, z, w = (log.tip_quaternion[:, k] for k in (1, 2, 3, 0))
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)], axis=-1)
    return log.tip_m - 0.1 * axis


def test_recorded_positions_are_the_waypoints(expert, waypoints, plan, shift_mm):
    printed = []
    arm = IdealArm()
    result = WaypointRecorder(arm, expert, printed.append).record(waypoints[:3], plan)
    assert result.ending.status == 0 and len(result.log) == len(printed) == 3
    wanted_m = np.stack([waypoint.finger_m for waypoint in waypoints[:3]])
    off_m = np.linalg.norm(fingers_m(result.log) - wanted_m, axis=1)
    assert off_m.max() < CLOSE_M < 1e-3 * np.linalg.norm(shift_mm)  # uncorrected, it is off by the shift
    np.testing.assert_allclose(result.off_m, off_m, atol=1e-6)
    assert np.abs(arm.pressure_kpa).max() < 10.0  # vented: falling with a lag


def test_blind_arm_is_logged_where_it_was_planned(expert, waypoints, plan, shift_mm):
    arm = BlindArm()
    seen = []
    result = WaypointRecorder(arm, expert, lambda _: seen.append(arm.finger_m)).record(waypoints[:2], plan)
    assert result.ending.status == 0 and np.isnan(result.off_m).all()
    wanted_m = np.stack([waypoint.finger_m for waypoint in waypoints[:2]])
    np.testing.assert_allclose(fingers_m(result.log), wanted_m, atol=1e-4)
    np.testing.assert_allclose(np.stack(seen), wanted_m - 1e-3 * shift_mm, atol=1.5e-3)


def test_posture_that_saturates_the_arm_gives_way_to_another(expert, waypoints, plan):
    """The second posture asks for a spring that its chamber cannot make; the arm gets there all the same."""
    spring_m = plan.spring_m.copy()
    spring_m[1, 4] += 0.06
    broken = Posture(**{**plan._asdict(), "spring_m": spring_m})
    result = WaypointRecorder(IdealArm(), expert).record(waypoints[:2], broken)
    assert result.ending.status == 0 and result.off_m.max() < CLOSE_M


@pytest.mark.parametrize("spring_mm, up_mm", [(60.0, 0.0), (0.0, 2.0)], ids=["no rest", "farther off"])
def test_best_pose_is_logged_where_corrections_are_worse(expert, waypoints, plan, shift_mm, spring_mm, up_mm):
    """The first pose is off by the shift; then impossible springs are asked for, or a wrong place."""

    class Worse:
        spec, target, up_m = expert.spec, expert.target, 1e-3 * up_mm

        def reach(self, name, target, before_kpa):
            self.up_m *= 3  # or the recorder would correct it
            wrong = target._replace(finger_m=target.finger_m + [0.0, 0.0, self.up_m])
            found = expert.reach(name, wrong, before_kpa)
            return found._replace(spring_m=found.spring_m + 1e-3 * spring_mm * (np.arange(9) == 4))

    result = WaypointRecorder(IdealArm(), Worse()).record(waypoints[:1], plan)
    assert result.ending.status == 0
    np.testing.assert_allclose(result.off_m, 1e-3 * np.linalg.norm(shift_mm), rtol=0.1)
    wanted_m = np.stack([waypoints[0].finger_m])
    np.testing.assert_allclose(np.linalg.norm(fingers_m(result.log) - wanted_m, axis=1), result.off_m)


class Lost(IdealArm):
    """Readings are lost some ticks after the first pose was logged."""

    n_ticks_left = np.inf

    def read_sensors(self):
        self.n_ticks_left -= 1
        if self.n_ticks_left < 0:
            raise TimeoutError
        return super().read_sensors()


class Misplaced(IdealArm):
    """Motion capture does not follow: whatever is corrected, the arm seems to be elsewhere."""

    def motion_capture(self):
        _, *others = super().motion_capture()
        return Capture(np.array([0.05, 0.0, -0.5]), *others)


class Leaking(IdealArm):
    """One chamber holds no pressure."""

    def write_pressures(self, pressure_kpa):
        super().write_pressures(np.where(np.arange(SPEC.n_chambers) == 4, 0.0, pressure_kpa))


@pytest.mark.parametrize(
    ("kind", "n_logged", "causes"),
    [
        (Lost, 1, ["got 3 lost readings in a row"]),
        (Misplaced, 0, ["home: got 7"]),
        (Leaking, 0, ["home: got no rest, expected it within 15 s; spring 4 is +", "chamber at -40.0 kPa"]),
    ],
)
def test_a_fault_ends_the_recording_and_what_was_logged_before_stays(
    expert, waypoints, plan, kind, n_logged, causes
):
    arm = kind()
    tell = lambda _: setattr(arm, "n_ticks_left", 20)  # noqa: E731
    result = WaypointRecorder(arm, expert, tell).record(waypoints, plan)
    assert len(result.log) == n_logged
    assert all(cause in result.ending.cause for cause in causes)


@pytest.fixture
def command(tmp_path, shifting_s2r, monkeypatch, capsys):
    """Runs `python -m train demos` on the ideal arm, with the calibration that believes it to be off."""
    SPEC.to_toml(tmp_path / "arm.toml")
    save_s2r(tmp_path / S2R_FILE, shifting_s2r)
    monkeypatch.setattr("mjx_softarm.deploy.drivers.names.open_arm", lambda name: IdealArm())

    def run(*args):
        status = main(["demos", *map(str, args), "--calibration", str(tmp_path)])
        captured = capsys.readouterr()
        return status, captured.out + captured.err

    return run


RECORD = ("record", "--arm", "a:B", "--out")


def test_the_command_records_a_task_and_checks_its_file(command, tmp_path, monkeypatch, waypoints):
    _, pipe = task("pipe300", SPEC)
    monkeypatch.setattr("train.demos.record.task", lambda name, spec: (waypoints[:2], pipe))
    out = tmp_path / "demos.csv"
    status, printed = command(*RECORD, out, "--task", "pipe300")
    assert status == 0, printed
    assert f"demonstrations: {out}, 2 poses" in printed and "furthest from its waypoint: " in printed
    log, _ = read_demonstrations(out, SPEC)
    wanted_m = np.stack([waypoint.finger_m for waypoint in waypoints[:2]])
    assert np.linalg.norm(fingers_m(log) - wanted_m, axis=1).max() < CLOSE_M
    status, printed = command("check", out)
    assert status == 0 and "poses: 2" in printed and "sequences: 1: 0 with 2" in printed


def test_misuse_is_told_before_anything_moves(command, tmp_path):
    (tmp_path / "arm.csv").touch()
    for args, message in (
        ((*RECORD, tmp_path / "no" / "x.csv", "--task", "pipe300"), "expected a file in a folder that"),
        ((*RECORD, tmp_path / "arm.csv", "--task", "pipe300"), "arm.csv, which is there already, expected"),
        ((*RECORD, tmp_path / "x.xlsx", "--task", "pipe300"), "expected a name that ends in .csv or .npz"),
        (("check", tmp_path / "none.csv"), "none.csv: got 'No such file"),
    ):
        status, printed = command(*args)
        assert status == 2 and message in printed
