"""Recording on a linear arm: random pressures, poses at rest, the motion between them, an early end.

Poses at rest are those that calibration finds in the log.
"""

import dataclasses
import re

import numpy as np
import pytest

from calib.read.logs import read_log
from calib.read.static_poses import find_static_poses
from mjx_softarm.deploy import record as recording
from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.deploy.ending import Ending
from mjx_softarm.deploy.link import VENT_KPA_PER_S
from mjx_softarm.deploy.record import STEP_SHARE, prediction_errors_mm, record
from mjx_softarm.logs.schema import write_log
from mjx_softarm.mechanics.body import holes_m, spring_directions
from mjx_softarm.mechanics.excitation import growing, random_pressures
from mjx_softarm.posture import base_rotation
from mjx_softarm.sensing.estimator import Frame, even_pose
from tests.linear_arm import (
    DT_S,
    GAIN_M_PER_KPA,
    HIGH_KPA,
    LOW_KPA,
    REST_M,
    SPEC,
    Blind,
    LinearArm,
    N,
    nan,
)


def test_random_pressures_follow_the_arcsine_law():
    kpa = random_pressures(SPEC, 20_000, 0)
    assert kpa.min() >= LOW_KPA and kpa.max() <= HIGH_KPA
    share = (kpa - LOW_KPA) / (HIGH_KPA - LOW_KPA)
    for x in (0.05, 0.3, 0.5, 0.9):
        assert np.mean(share < x) == pytest.approx(2 / np.pi * np.arcsin(np.sqrt(x)), abs=0.01)
    np.testing.assert_array_equal(kpa[:5], random_pressures(SPEC, 20_000, 0)[:5])


def test_every_tick_is_recorded_and_steps_lead_to_ramps():
    arm, targets_kpa, lines = LinearArm(), random_pressures(SPEC, 3, 3), []
    result = record(arm, SPEC, targets_kpa, tell=lines.append)
    assert lines == ["3 of 3 poses, about 0.0 min left"]
    assert (result.n_poses, result.n_unsettled, result.ending) == (3, 0, Ending())
    np.testing.assert_array_equal(result.log.pressure_kpa[1:], arm.written[: len(result.log) - 1])
    np.testing.assert_array_equal(arm.command_kpa, 0.0)
    # One step towards each pose, a ramp after it and to the end
    steps_kpa = np.abs(np.diff(np.array(arm.written), axis=0)).max(axis=1)
    ramp_kpa = VENT_KPA_PER_S * DT_S + 1e-9
    first_kpa = np.abs(arm.written[0]).max()
    assert (steps_kpa > ramp_kpa).sum() + (first_kpa > ramp_kpa) == 3
    assert max(first_kpa, steps_kpa.max()) == pytest.approx(STEP_SHARE * (HIGH_KPA - LOW_KPA) + ramp_kpa)


class Seen(LinearArm):
    """A slow arm whose tip, seen but for some frames, follows its first springs; pressures are measured."""

    def write_pressures(self, pressure_kpa):
        before_kpa = self.actual_kpa
        super().write_pressures(pressure_kpa)
        self.actual_kpa = before_kpa + DT_S * (self.holds(self.command_kpa) - before_kpa)  # within 1 s

    def pressures(self):
        return self.actual_kpa + 0.05 * self._rng.standard_normal(N)

    def motion_capture(self):
        if self.tick % 7 == 0:
            raise OSError("frame dropped")
        tip_m = self.spring_m[:3] + 2e-4 * self._rng.standard_normal(3)
        sign = (-1) ** self.tick  # both are the same rotation
        return Capture(tip_m, sign * np.array([0.8, 0.6, 0.0, 0.0]), tip_m[None])


def test_calibration_finds_each_recorded_pose(tmp_path):
    targets_kpa = growing(random_pressures(SPEC, 6, 3))
    result = record(Seen(), SPEC, targets_kpa)
    assert (result.n_poses, result.n_unsettled) == (6, 0)
    write_log(tmp_path / "log.npz", dataclasses.replace(result.log, tip_m=result.log.tip_m - [0, 0, 0.6]))
    log, _ = read_log(tmp_path / "log.npz")
    poses, row_uses = find_static_poses([log], SPEC)
    assert poses.n == 6 and row_uses["tip still moving"] == 0
    spring_m = REST_M + poses.pressure_kpa @ GAIN_M_PER_KPA.T
    np.testing.assert_allclose(poses.pressure_kpa, targets_kpa, atol=1.0)
    np.testing.assert_allclose(poses.with_lengths(SPEC).spring_m, spring_m, atol=4e-5)
    off_m = poses.tip_m + [0, 0, 0.6] - spring_m[:, :3]
    assert np.std(off_m) == pytest.approx(2e-4 / np.sqrt(43), rel=0.4)  # of 50 ticks, 43 seen
    np.testing.assert_allclose(np.abs(poses.tip_rotation[:, 1, 2]), 0.96, atol=1e-6)


class Hidden(Seen):
    """A second marker that is never seen, a third now and then, and springs in every third frame only."""

    def motion_capture(self):
        seen = super().motion_capture()
        third_m = seen.tip_m if self.tick % 2 else np.full(3, np.inf)
        spring_m = None if self.tick % 3 else self.spring_m
        return seen._replace(marker_m=np.array([seen.tip_m, np.full(3, np.nan), third_m]), spring_m=spring_m)


def test_hidden_markers_cost_no_pose():
    result = record(Hidden(), SPEC, growing(random_pressures(SPEC, 2, 3)))
    assert (result.n_poses, result.n_unsettled, result.ending) == (2, 0, Ending())
    assert np.isnan(result.log.marker_m[:, 1]).all()
    assert find_static_poses([result.log], SPEC)[0].n == 2


class Gone(Seen):
    """Motion capture misses all frames from some time on."""

    def motion_capture(self):
        if self.time_s > 30.0:
            raise OSError("the server is gone")
        return super().motion_capture()


def test_recording_ends_once_motion_capture_is_gone():
    arm = Gone()
    result = record(arm, SPEC, random_pressures(SPEC, 50, 3))
    assert "motion_capture: got no frame in 3 poses, expected the tip in each" in result.ending.cause
    assert 1 < result.n_poses < 10 and result.n_unsettled in (3, 4) and result.ending.status == 3
    assert not arm.command_kpa.any()


def test_first_poses_grow_from_small_to_full():
    targets_kpa = random_pressures(SPEC, 12, 3)
    np.testing.assert_allclose((growing(targets_kpa) / targets_kpa)[:, 0], [*np.arange(0.1, 1.1, 0.1), 1, 1])


class Leaking(Seen):
    """Chamber 4 holds no pressure."""

    def holds(self, pressure_kpa):
        return np.where(np.arange(N) == 4, 0.0, pressure_kpa)


def frozen(readings):
    return np.where(np.arange(N) == 4, 5e6, readings)


@pytest.mark.parametrize(
    ("arm", "message"),
    [
        (Blind(range(10**6), frozen), "spring4: got the same reading always"),
        (Leaking(), "pressures: chamber4: got -?0.[01] kPa at rest, expected -?[0-9]"),
    ],
)
def test_recording_stops_at_a_fault_while_poses_are_small(arm, message):
    result = record(arm, SPEC, growing(random_pressures(SPEC, 50, 3)))
    assert re.match(message, result.ending.cause) and result.ending.status == 3
    assert result.n_poses < 3 and not arm.command_kpa.any()
    assert np.abs(arm.written).max() < 0.31 * max(-LOW_KPA, HIGH_KPA)


def curve(n, noise_m, seed=0):
    """Poses whose tip is a smooth function of the springs beside even bending, and noise."""
    rng = np.random.default_rng(seed)
    spring_m = 0.2 + 0.03 * rng.uniform(-1.0, 1.0, (n, SPEC.n_springs))
    base = Frame(np.array(SPEC.mounting.base_offset_m), base_rotation(SPEC))
    site_m = holes_m(spring_directions(SPEC), SPEC.per_section(SPEC.geometry.spring_radius_m))
    tip_m = 1e-3 * even_pose(base, site_m, spring_m)[:, :3] + 0.02 * np.sin(60.0 * spring_m[:, :3])
    return np.concatenate([spring_m, tip_m + noise_m * rng.standard_normal((n, 3))], axis=1)


def test_more_poses_bring_something_until_noise_is_left():
    by_half_mm, by_others_mm = prediction_errors_mm(curve(80, 1e-5), SPEC)
    assert by_others_mm < 0.9 * by_half_mm
    by_half_mm, by_others_mm = prediction_errors_mm(curve(200, 0.01), SPEC)
    assert by_others_mm > 0.9 * by_half_mm
    assert by_others_mm == pytest.approx(10.0 * 1.54, rel=0.2)  # median of the length of three normal errors


class Noisy(Seen):
    """Motion capture shows another random tip, metres off, at each command."""

    def motion_capture(self):
        seed = [int(x) for x in 1e6 * (self.command_kpa + 100.0)]
        tip_m = np.random.default_rng(seed).standard_normal(3)
        return Capture(tip_m, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros((0, 3)))


@pytest.fixture
def checked_early(monkeypatch):
    monkeypatch.setattr(recording, "MIN_POSES", 10)
    monkeypatch.setattr(recording, "CHECK_POSES", 5)


def test_a_recording_ends_where_more_poses_bring_nothing(checked_early):
    lines = []
    result = record(Noisy(), SPEC, growing(random_pressures(SPEC, 60, 3)), tell=lines.append)
    assert result.n_poses < 60 and result.ending == Ending()
    assert lines[-1] == "half of them predict as well: more poses bring nothing"
    error_mm = float(re.search("from the others to ([0-9.]+) mm", lines[-2])[1])
    assert error_mm == pytest.approx(1540.0, rel=0.4)  # median of the length of three normal numbers


class Restless(Seen):
    """The tip never rests at one set of pressures."""

    def __init__(self, at_kpa):
        super().__init__()
        self.at_kpa = at_kpa

    def motion_capture(self):
        off_m = 0.1 * self._rng.standard_normal(3) if np.array_equal(self.command_kpa, self.at_kpa) else 0.0
        return Capture(self.spring_m[:3] + off_m, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros((0, 3)))


def test_a_pose_that_never_rests_is_no_second_check(checked_early, monkeypatch):
    monkeypatch.setattr(recording, "prediction_errors_mm", lambda poses, spec: (1.0, 1.0))
    targets_kpa = growing(random_pressures(SPEC, 30, 3))
    result = record(Restless(targets_kpa[10]), SPEC, targets_kpa)
    assert (result.n_poses, result.n_unsettled) == (15, 1)


def test_recording_stops_and_vents_when_readings_are_lost():
    arm = Blind(range(450, 10**6), nan)
    result = record(arm, SPEC, random_pressures(SPEC, 50, 3))
    assert "got 3 lost readings in a row" in result.ending.cause and result.ending.status == 3
    assert 0 < result.n_poses < 50
    np.testing.assert_array_equal(arm.command_kpa, 0.0)
