"""Both engines in motion against C MuJoCo, whose chambers are filled by the twin's pneumatics."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_softarm import ArmSpec, control
from mjx_softarm._support import xla
from mjx_softarm._support.lazy import put
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.mjcf import build_model, chamber_lengths, spring_lengths
from mjx_softarm.mechanics.motion import midpoint, mjx_step
from mjx_softarm.mechanics.motion.state import (
    CREEP_M_PER_S,
    Motion,
    MotionParams,
    MotionResult,
    MovingArm,
    n_earlier,
)
from mjx_softarm.mechanics.params import PAYLOAD, ArmParams
from mjx_softarm.mechanics.statics import all_tendons, chambers_and_springs
from mjx_softarm.mechanics.workspace import settle_many
from tests.arms import SHORT

SPEC = ArmSpec.default()
GAINS, PERIOD_S = control.Gains.from_spec(SPEC), 0.02
TRUE_STEP_S = 2.5e-4  # at 1 ms MuJoCo itself is 0.4 mm (95 %) from this
N_HOLDS, HOLD_TICKS = 4, 25  # a new reference each half second, for 2 s


pytestmark = pytest.mark.usefixtures("quick_compiler")


def starts(spec, n):
    """Joint coordinates and pressures of arms at rest under random pressures."""
    rng = np.random.default_rng(0)
    pressure = np.float32(rng.uniform(-30.0, 15.0, (n, spec.n_chambers)))
    return settle_many(spec, pressure).q, pressure


def references(spec, n):
    """Random spring lengths (n, ticks, chambers) over all that may be commanded, each held for a while."""
    low, high = spec.springs.length_min_m, spec.springs.length_max_m
    asked = np.random.default_rng(1).uniform(low, high, (n, N_HOLDS, spec.n_chambers))
    return np.repeat(asked, HOLD_TICKS, axis=1)


def true_tips(spec, q, pressure_kpa, reference_m, step_s=TRUE_STEP_S, model=None, before_step=None):
    """Tips (ticks, 3) [m] of C MuJoCo after each tick, with references (ticks, chambers).

    A function of the data may set forces or dampers before each time step.
    """
    model = model or build_model(spec)
    model.opt.timestep, model.actuator_ctrllimited[:] = step_s, 0
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_step1(model, data)
    n = spec.n_chambers
    air = spec.pneumatics(chamber_lengths(data, n), step_s)
    air.hold(pressure_kpa, chamber_lengths(data, n))
    law, tips = control.LawState.at_rest(pressure_kpa, spring_lengths(data, n, n)), []
    for reference in reference_m:
        command, law = control.pressures(reference, spring_lengths(data, n, n), law, GAINS, PERIOD_S)
        air.command(command)
        for _ in range(round(PERIOD_S / step_s)):
            data.ctrl[:] = air.step(chamber_lengths(data, n))
            if before_step:
                before_step(data)
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
        tips.append(data.site("tip").xpos.copy())
    return np.array(tips)


def all_true_tips(spec, start, reference_m, *model, least_mm=20.0):
    """Tips (n, ticks, 3) [m] of C MuJoCo of arms whose paths have a mean length of `least_mm` or more."""
    true = np.array([true_tips(spec, *each, *model) for each in zip(*start, reference_m, strict=True)])
    assert 1e3 * np.linalg.norm(np.diff(true, axis=1), axis=-1).sum(axis=1).mean() > least_mm
    return true


def dry_friction(friction_n):
    """Function that pushes each chamber against the rate of its length."""

    def push(data):
        chambers = slice(data.ctrl.size)
        jacobian = data.ten_J.reshape(-1, data.qpos.size)[chambers]  # dense: each tendon crosses all links
        rate = data.ten_velocity[chambers]
        data.qfrc_applied[:] = -jacobian.T @ (friction_n * rate / np.sqrt(rate**2 + CREEP_M_PER_S**2))

    return push


def mover(spec, engine=midpoint, step_s=PERIOD_S, longest_delay_s=0.0):
    """Function of joint coordinates, pressures, references (ticks, chambers), own numbers: the results."""
    model, data = put(build_model(spec))
    nominal = jax.tree.map(jnp.asarray, ArmParams.from_spec(spec))

    def move(q, pressure_kpa, reference_m, own, params):
        arm = MovingArm(model, data, params, own)
        _, springs = chambers_and_springs(all_tendons(chain_kinematics(params)(q), params), params)
        start = Motion.at_rest(q, pressure_kpa, springs.length, n_earlier(longest_delay_s, PERIOD_S))

        def tick(motion, reference):
            return engine.advance(arm, motion, reference, GAINS, PERIOD_S, PERIOD_S, step_s)

        return jax.lax.scan(tick, start, reference_m)[1]

    many = xla.jit(jax.vmap(move, in_axes=(0, 0, 0, None, None)))
    return lambda *args, params=nominal: many(*args, params)


@pytest.mark.parametrize(("links", "share"), [(1, 1.0), pytest.param(4, 0.0, marks=pytest.mark.slow)])
def test_transients_of_both_engines_are_those_of_c_mujoco(links, share):
    """Within 1 mm at 95 % over 1 s, with a random reference each half second."""
    spec = SPEC.replace(structure={"links_per_section": links}, chambers={"bonded_share": share})
    n_arms = 4 + links
    start, asked = starts(spec, n_arms), references(spec, n_arms)[:, : 2 * HOLD_TICKS]
    true = all_true_tips(spec, start, asked, least_mm=150.0)

    for engine, step_s in ((midpoint, PERIOD_S), (mjx_step, 0.001)):
        moved = mover(spec, engine, step_s)(*start, np.float32(asked), MotionParams())
        assert (moved.result == MotionResult.FINITE.value).all()
        error_mm = 1e3 * np.linalg.norm(moved.tip_position_m - true, axis=-1)
        assert np.percentile(error_mm, 95) < 1.0 and np.median(error_mm) < 0.5


def test_the_inertia_is_that_of_c_mujoco():
    spec = SPEC.replace(structure={"links_per_section": 2})
    compiled, rng = build_model(spec), np.random.default_rng(0)
    q, v = rng.normal(size=(2, 3, compiled.nv)) * np.tile([0.02, 0.2, 0.2], spec.n_links)
    params = jax.tree.map(jnp.asarray, ArmParams.from_spec(spec))
    arm = MovingArm(*put(compiled), params, MotionParams())

    def dense(q, v):
        mass, bias = midpoint.inertia(arm, chain_kinematics(params)(q), v)
        return jax.vmap(mass.times)(jnp.eye(len(v))), bias

    compiled.opt.gravity[:] = 0.0
    for found_mass, found_bias, *at in zip(*jax.jit(jax.vmap(dense))(q, v), q, v, strict=True):
        data, mass = mujoco.MjData(compiled), np.zeros((compiled.nv, compiled.nv))
        data.qpos[:], data.qvel[:] = at
        mujoco.mj_forward(compiled, data)
        for row, unit in zip(mass, np.eye(compiled.nv), strict=True):
            mujoco.mj_mulM(compiled, data, row, unit)
        np.testing.assert_allclose(found_mass, mass, atol=1e-6 * mass.max())
        np.testing.assert_allclose(found_bias, data.qfrc_bias, atol=1e-5 * np.abs(data.qfrc_bias).max())


@pytest.fixture(scope="module")
def short():
    """Four small arms, references that change each half second, and the function that moves them."""
    return starts(SHORT, 4), np.float32(references(SHORT, 4)), mover(SHORT)


def test_mjx_steps_as_c_mujoco_does():
    """With an episode's payload, stiffness, damping and friction; MJX has float32, C MuJoCo float64."""
    step_s, own = 0.005, MotionParams(damping=1.2, friction_n=1.5)
    start, asked = starts(SHORT, 4), references(SHORT, 4)
    nominal = ArmParams.from_spec(SHORT)
    stiffness = np.float32(nominal.chamber_stiffness * [0.9, 1.0, 1.1])
    masses = np.float32(nominal.tool_mass_kg + 0.3 * np.eye(2)[PAYLOAD])
    params = nominal._replace(tool_mass_kg=masses, chamber_stiffness=stiffness)
    moved = mover(SHORT, mjx_step, step_s)(*start, np.float32(asked), own, params=params)

    model, chambers = build_model(SHORT), slice(SHORT.n_chambers)
    model.body("payload").mass, model.tendon_stiffness[chambers] = masses[PAYLOAD], stiffness
    model.dof_damping *= own.damping
    damping = own.damping * model.tendon_damping

    def set_dampers(data):
        rate = data.ten_velocity[chambers]
        model.tendon_damping[:] = damping
        model.tendon_damping[chambers] += own.friction_n / np.sqrt(rate**2 + CREEP_M_PER_S**2)
        mujoco.mj_fwdVelocity(model, data)

    true = all_true_tips(SHORT, start, asked, step_s, model, set_dampers)
    np.testing.assert_allclose(moved.tip_position_m, true, atol=1e-6)


def test_commands_in_force_are_their_mean_over_the_time_before_the_dead_time():
    """Ten control periods in two intervals each, against a mean over fine steps of time."""
    delay_s, h, fine = np.array([0.0, 0.013, 0.05, 0.0875]), PERIOD_S / 2, 1e-5
    told = np.random.default_rng(0).normal(size=(10, 4))
    zeros = jnp.zeros(4)
    motion = Motion.at_rest(zeros, zeros, zeros, n_earlier(delay_s.max(), PERIOD_S))
    for period, command in enumerate(jnp.float32(told)):
        for k in range(2):
            with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
                got = motion.in_force(command, k, h, jnp.float32(delay_s), PERIOD_S)
            time_s = PERIOD_S * period + h * k + np.arange(0.5 * fine, h, fine)[:, None] - delay_s
            index = np.floor(time_s / PERIOD_S).astype(int)
            by_hand = np.where(index < 0, 0.0, told[np.maximum(index, 0), np.arange(4)]).mean(axis=0)
            np.testing.assert_allclose(got, by_hand, atol=1e-4)
        motion = motion.commanded(command)


@pytest.mark.parametrize(
    ("engine", "step_s", "share", "most_mm"),
    [(midpoint, PERIOD_S, 1.0, 0.3), (midpoint, PERIOD_S, 0.0, 0.3), (mjx_step, 0.005, 1.0, 0.8)],
)
def test_arms_behind_slow_regulators_move_as_c_mujoco_does(engine, step_s, share, most_mm):
    """Commands wait for no, two and a half, and some four control periods; `share` of the volume counts."""
    dead_time_s = (0.0, 0.05, 0.085)
    numbers = {"lag_s": 0.3, "fill_kpa_per_s": 60.0, "vent_kpa_per_s": 25.0, "deadband_kpa": 0.2}
    numbers["volume_share"] = share
    spec = SHORT.replace(actuators={"kind": "regulator", "dead_time_s": dead_time_s, **numbers})
    start, asked = starts(spec, 4), references(spec, 4)
    regulator = jax.tree.map(np.float32, spec.actuators.per_chamber(3))
    own = MotionParams(delay_s=regulator.delay_s, actuators=regulator)
    moved = mover(spec, engine, step_s, max(dead_time_s))(*start, np.float32(asked), own)
    true = all_true_tips(spec, start, asked)
    assert 1e3 * np.percentile(np.linalg.norm(moved.tip_position_m - true, axis=-1), 95) < most_mm


def test_dry_friction_is_that_of_c_mujoco(short):
    """Pushed back along its path by up to 8 N in each chamber, which changes the path by millimetres."""
    friction_n, (start, asked, move) = 8.0, short
    moved, free = (
        np.asarray(move(*start, asked, MotionParams(friction_n=f)).tip_position_m) for f in (friction_n, 0.0)
    )
    true = all_true_tips(SHORT, start, asked, TRUE_STEP_S, None, dry_friction(friction_n))
    off_mm, change_mm = (1e3 * np.linalg.norm(moved - x, axis=-1) for x in (true, free))
    assert np.percentile(change_mm, 95) > 3.0
    assert np.percentile(off_mm, 95) < 0.1 * np.percentile(change_mm, 95)


def test_what_fails_says_so_and_its_neighbours_do_not(short):
    """An arm without a number, and one with lengths that no arm has: its time step is to blame."""
    (q, pressure), asked, move = short
    clean = move(q, pressure, asked, MotionParams())
    broken = np.array(q)
    broken[1, 0], broken[2] = 2.0, np.nan
    moved = move(broken, pressure, asked, MotionParams())
    assert moved.result[1, 0] == MotionResult.DIVERGED.value
    assert (moved.result[2] == MotionResult.NOT_FINITE.value).all()
    assert "time step is too long" in MotionResult.DIVERGED.text
    for name in ("tip_position_m", "pressure_kpa", "result"):
        for arm in (0, 3):
            np.testing.assert_array_equal(getattr(moved, name)[arm], getattr(clean, name)[arm])
