"""The twin against closed forms, hand calculations and the equilibrium solver."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_softarm._support.errors import InputError
from mjx_softarm.control import Gains, LawState, pressures
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.mjcf import chamber_lengths, spring_lengths
from mjx_softarm.mechanics.workspace import settle_many
from mjx_softarm.spec import ArmSpec
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.instruments import PRESSURE_NOISE_KPA, Build
from mjx_softarm.twin.model import build_twin, draw_parts
from mjx_softarm.twin.rod_twin import RodTwin
from tests.twin.conftest import KPA, PRESSURES_KPA, hold

SOPRA = ArmSpec.of(Path("sopra"))
both_kinds = pytest.mark.parametrize("kind", ["", "rod:"])
IDEAL = Build(gap=0.0, losses=0.0, noise=0.0, per_section=4)  # training's model, moving


def hold_springs(arm, reference_m, pressure_kpa, gains, duration_s, sensor):
    """Run the sensor-space law on an arm at rest at pressures (n,)."""
    law = LawState.at_rest(pressure_kpa, sensor.lengths(arm.read_sensors()).length_m)
    for _ in range(round(50 * duration_s)):
        length_m = sensor.lengths(arm.read_sensors()).length_m
        command, law = pressures(reference_m, length_m, law, gains, 0.02)
        arm.write_pressures(command)


def test_ideal_twin_rests_where_settle_says(spec):
    """With a payload from the start, without it, and with it again."""
    arm = Twin(0, payload_kg=0.5, build=IDEAL)
    for payload_kg in (0.5, 0.0, 0.5):
        arm.attach(payload_kg)
        expected = settle_many(spec.replace(mass={"payload_kg": payload_kg}), PRESSURES_KPA)
        assert expected.settled.all()
        for k, pressure in enumerate(PRESSURES_KPA):
            hold(arm, pressure, 12.0)
            read_m = spec.spring_sensor.lengths(arm.read_sensors()).length_m
            np.testing.assert_allclose(arm.motion_capture().tip_m, expected.tip_position_m[k], atol=2e-5)
            np.testing.assert_allclose(read_m, expected.spring_m[k], atol=2e-5)
            np.testing.assert_allclose(arm.pressures(), pressure, atol=1e-3)


def test_ideal_twins_of_other_arms_rest_where_settle_says(other_arm):
    """Four chambers a section, six with three springs, sections that differ; some pressures are redundant."""
    pressure_kpa = 0.5 * random_pressures(other_arm, 1, 3)
    expected = settle_many(other_arm, pressure_kpa)
    arm = Twin(0, other_arm, build=IDEAL)
    hold(arm, pressure_kpa[0], 12.0)
    read_m = other_arm.spring_sensor.lengths(arm.read_sensors()).length_m
    assert expected.settled.all()
    np.testing.assert_allclose(arm.motion_capture().tip_m, expected.tip_position_m[0], atol=4e-5)
    np.testing.assert_allclose(read_m, expected.spring_m[0], atol=2e-5)


def test_twisted_mounting_turns_the_sections_and_stretches_nothing(spec):
    twist_rad = np.array([0.1, 0.2, -0.05])
    parts = draw_parts(0, spec, Build(gap=0.0))._replace(twist_rad=twist_rad)
    model = build_twin(parts)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.ten_length, 0.2, atol=1e-12)
    yaw = [
        Rotation.from_matrix(data.body(f"link{k}").xmat.reshape(3, 3)).as_euler("ZYX")[0] for k in (5, 15, 29)
    ]
    np.testing.assert_allclose(yaw, np.cumsum(twist_rad), atol=1e-12)


def test_tolerances_reach_the_compiled_model(spec):
    parts = draw_parts(4, spec, Build())
    model = build_twin(parts)
    stiffness = np.array(parts.spec.chambers.stiffness_n_per_m)
    area = np.array(parts.spec.chambers.area_m2)
    assert np.ptp(stiffness) > 10 and np.ptp(area) > 1e-5
    np.testing.assert_allclose(model.tendon_stiffness[:9], stiffness)
    slope = np.array(parts.spec.chambers.area_slope_m)
    gain = 1e3 * (area - slope * spec.geometry.section_length_m)
    np.testing.assert_allclose(model.actuator_gainprm[:9, 0], gain)
    mass = spec.mass.arm_kg / 30 * parts.link_mass
    np.testing.assert_allclose(model.body_mass[1:31], mass)
    axial = 10 * spec.backbone.axial_stiffness_n_per_m * parts.backbone
    np.testing.assert_allclose(model.jnt_stiffness[0::3], np.repeat(axial, 10))
    for kind, hole_m in parts.hole_m.items():
        inside = np.array([model.site(f"{kind}{k}_plate{10 * (k // 3) + 5}").pos[:2] for k in range(9)])
        np.testing.assert_allclose(inside, hole_m)
    assert np.linalg.norm(model.opt.gravity) == pytest.approx(9.81)
    np.testing.assert_allclose(parts.base_rotation @ model.opt.gravity, [0, 0, -9.81], atol=1e-12)


def test_closed_loop_in_pressure_dissipates():
    """Work of the air over a closed loop: little in a nearly undamped arm, much with losses."""
    work_j = []
    for losses in (0.0, 1.0):
        arm = Twin(1, build=Build(losses=losses, per_section=4))
        arm._model.tendon_damping[:] *= 0.05
        arm._model.dof_damping[:] *= 0.05
        work_of_pressures(arm, 300)
        work_j.append(work_of_pressures(arm, 300))
    assert 0.0 < work_j[0] < 0.2 * work_j[1]


def work_of_pressures(arm, n_ticks):
    """Work [J] that the air does on the arm while three chambers go down to -20 kPa and back."""
    work, length_m, pressure = 0.0, chamber_lengths(arm._data, 9).copy(), arm._air.pressure_kpa
    for phase in np.linspace(0.0, 2 * np.pi, n_ticks):
        arm.write_pressures(-10.0 * (1.0 - np.cos(phase)) * np.array([1, 0, 0, 0, 1, 0, 0, 0, 1]))
        next_length_m, next_pressure = chamber_lengths(arm._data, 9).copy(), arm._air.pressure_kpa
        grown_m3 = arm._air.volume_m3(next_length_m) - arm._air.volume_m3(length_m)
        work += 1e3 * np.sum(0.5 * (pressure + next_pressure) * grown_m3)
        length_m, pressure = next_length_m, next_pressure
    return work


def test_arm_that_is_pushed_comes_back_to_rest():
    """No energy from the losses' delay of one time step: a twin at constant pressures stays at rest."""
    arm = Twin(5, build=Build(noise=0.0))
    hold(arm, PRESSURES_KPA[2], 5.0)
    arm._data.qvel[:] += 0.3 * np.random.default_rng(0).standard_normal(arm._data.qvel.shape)
    mujoco.mj_step1(arm._model, arm._data)
    hold(arm, PRESSURES_KPA[2], 5.0)
    assert np.abs(arm._data.qvel).max() < 1e-3


def test_readings_are_counts_and_springs_have_their_own_calibration(spec):
    """The true beta and delta give the spring's length; the nominal ones are millimetres off."""
    noiseless = hold(Twin(3, build=Build(noise=0.0)), KPA, 2.0)
    readings, true_m = noiseless.read_sensors(), spring_lengths(noiseless._data, 9, 9)
    count = readings / (40e6 / 2**28)
    np.testing.assert_array_equal(count, np.round(count))
    calibrated = noiseless._parts.sensor.lengths(readings).length_m
    nominal = spec.spring_sensor.lengths(readings).length_m
    np.testing.assert_allclose(calibrated, true_m, atol=3e-8)  # half a count is 1e-8 m
    assert np.abs(nominal - true_m).max() > 1e-3


def test_noise_is_as_large_as_documented():
    arm = Twin(3)
    readings = np.array([arm.read_sensors() for _ in range(300)])
    pressure_kpa = np.array([arm.pressures() for _ in range(300)])
    captures = [arm.motion_capture() for _ in range(300)]
    tip_m = np.array([capture.tip_m for capture in captures])
    turn = Rotation.from_quat([capture.tip_quaternion for capture in captures], scalar_first=True)
    off_deg = np.rad2deg((turn * turn.mean().inv()).as_rotvec())
    assert readings.std(axis=0).mean() == pytest.approx(arm._parts.sensor.noise, rel=0.1)
    assert pressure_kpa.std(axis=0).mean() == pytest.approx(PRESSURE_NOISE_KPA, rel=0.1)
    assert 1e3 * tip_m.std(axis=0).mean() == pytest.approx(0.2, rel=0.15)
    assert off_deg.std(axis=0).mean() == pytest.approx(0.1, rel=0.15)


def test_springs_reach_their_references_from_any_side(spec):
    """The law at 50 Hz; what hysteresis leaves at the tip once the springs are where they should be."""
    gains, tips_m = Gains.from_spec(spec), []
    reference_m = settle_many(spec, 0.5 * PRESSURES_KPA[1:2]).spring_m[0].astype(float)
    arm = Twin(2, build=Build(per_section=5))
    for start_kpa in (-14.0, 4.0):
        hold(arm, start_kpa, 3.0)
        hold_springs(arm, reference_m, np.full(9, start_kpa), gains, 9.0, arm._parts.sensor)
        np.testing.assert_allclose(spring_lengths(arm._data, 9, 9), reference_m, atol=3e-4)
        tips_m.append(np.mean([arm.motion_capture().tip_m for _ in range(50)], axis=0))
    assert np.linalg.norm(tips_m[0] - tips_m[1]) < 2e-3


def test_survives_random_extremes():
    """Every chamber at one of its limits, redrawn at random after 1 to 50 ticks; a payload comes and goes."""
    arm, rng = Twin(0), np.random.default_rng(0)
    while arm.time_s < 20.0:
        arm.attach(rng.choice([0.0, 1.0]))
        hold(arm, rng.choice([-40.0, 20.0], 9), rng.integers(1, 51) / 50)
        assert np.isfinite(arm.read_sensors()).all()
        assert np.linalg.norm(arm.motion_capture().tip_m) < 1.2


@both_kinds
def test_a_payload_in_a_name(kind):
    named_m = open_arm(f"twin:{kind}3:500g").motion_capture().tip_m
    arm = (RodTwin if kind else Twin)(3, payload_kg=0.5)
    np.testing.assert_array_equal(named_m, arm.motion_capture().tip_m)


def test_a_payload_that_no_arm_carries_is_an_error():
    with pytest.raises(InputError, match="twin: got an unstable state"):
        open_arm("twin:3:99999999g")


@both_kinds
def test_a_twin_of_another_arm_by_name(kind, tmp_path):
    SOPRA.to_toml(tmp_path / "mine.toml")
    arm = open_arm(f"twin:{kind}7@{tmp_path / 'mine.toml'}")
    np.testing.assert_array_equal(arm.read_sensors(), open_arm(f"twin:{kind}7@sopra").read_sensors())
    straight_m = arm.motion_capture().tip_m[2]
    assert straight_m == pytest.approx(-SOPRA.length_m, abs=0.02)
    loaded = open_arm(f"twin:{kind}7@sopra:100g")
    assert loaded.motion_capture().tip_m[2] < straight_m - 1e-3
    with pytest.raises(InputError, match="absent.toml: got 'No such file or directory', expected a spec"):
        open_arm(f"twin:{kind}7@absent.toml")


@both_kinds
def test_an_exact_twin_has_the_specified_parts(kind):
    """Without noise, springs read the same in all of them, as those of the specification do."""
    lengths_m = [open_arm(f"twin:{kind}{seed}:exact")._lengths_m() for seed in (1, 2)]
    np.testing.assert_allclose(*lengths_m, atol=1e-9)
    sensor, specified = open_arm(f"twin:{kind}1:exact")._sensor, ArmSpec.default().spring_sensor
    np.testing.assert_array_equal(sensor.beta, specified.beta)
    np.testing.assert_array_equal(sensor.delta_m, specified.delta_m)


@both_kinds
def test_an_aged_twin_is_the_same_arm_with_shifted_zeros_and_softer_chambers(kind):
    """The shift alone shows at no pressure; the load on softer chambers lengthens the springs a little."""
    young, aged = (open_arm(f"twin:{kind}3{age}") for age in ("", ":aged"))
    off_m = aged._sensor.delta_m - young._sensor.delta_m
    np.testing.assert_allclose(np.abs(off_m), 1e-3, rtol=1e-9)
    assert 0 < np.count_nonzero(off_m > 0.0) < 9
    longer_m = aged._lengths_m() - young._lengths_m()
    assert 0.0 < longer_m.mean() < 2e-3
    assert np.array_equal(open_arm(f"twin:{kind}3:aged")._sensor.delta_m, aged._sensor.delta_m)
    assert open_arm(f"twin:{kind}3:aged:100g").motion_capture().tip_m[2] < aged.motion_capture().tip_m[2]


@both_kinds
def test_a_twin_may_have_lost_a_chamber(kind):
    whole, arm = (hold(open_arm(f"twin:{kind}3{lost}"), -5.0, 2.0) for lost in ("", ":lost4"))
    others = np.arange(9) != 4
    assert abs(arm._air.pressure_kpa[4]) < 0.3 and (arm._air.pressure_kpa[others] < -1.0).all()
    assert np.argmax(np.abs(arm._lengths_m() - whole._lengths_m())) == 4
