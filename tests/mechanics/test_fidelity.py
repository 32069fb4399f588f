"""Settled arm and stepped C MuJoCo come to the same rest under the sensor-space law.

The truth is C MuJoCo with the law in the loop, stepped until nothing moves. A rest depends on neither the
time step nor the damping nor the law's gains, so the truth is taken with those that come to rest soonest, and
one test holds it against the arm's own.
"""

import functools
from typing import NamedTuple

import jax
import mujoco
import numpy as np
import pytest

from mjx_softarm import ArmSpec, control
from mjx_softarm._support import xla
from mjx_softarm.mechanics.mjcf import build_model, spring_lengths
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import settle
from tests.arms import OTHER_ARMS

SPEC = ArmSpec.default()
GAINS = control.Gains.from_spec(SPEC)
N = 128
POSITION_MM, ANGLE_DEG = 0.1, 0.1

# Soonest at rest: one second a step, every damper worth four seconds of its spring, and strong gains.
FAST_STEP_S, FAST_DAMPING_S = 1.0, 4.0
FAST_GAINS = GAINS._replace(kp_kpa_per_m=600.0, ki_kpa_per_ms=200.0, kd_kpa_s_per_m=0.0, reference_s=0.0)


class Rest(NamedTuple):
    """Arms at rest, one a row, of C MuJoCo."""

    q: np.ndarray
    pressure_kpa: np.ndarray
    spring_m: np.ndarray
    tip_position_m: np.ndarray
    tip_rotation: np.ndarray
    residual: np.ndarray  # () largest force that is left on the standing arm [N, N m]


def references(n, seed, spec=SPEC):
    """Spring lengths (n, springs) over all that may be commanded."""
    low, high = map(spec.at_springs, (spec.springs.length_min_m, spec.springs.length_max_m))
    return np.random.default_rng(seed).uniform(low, high, (n, spec.n_springs))


def fast_model(spec=SPEC):
    model = build_model(spec)
    model.opt.timestep = FAST_STEP_S
    model.dof_damping[:] = FAST_DAMPING_S * model.jnt_stiffness[model.dof_jntid]
    model.tendon_damping[:] = FAST_DAMPING_S * model.tendon_stiffness
    return model


def stepped_to_rest(model, reference_m, gains, steps_per_tick=1, tolerance=1e-11, max_ticks=3000):
    """One arm in C MuJoCo, from the straight arm until neither it nor the law moves."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    period_s = steps_per_tick * model.opt.timestep
    law = control.LawState.at_rest(np.zeros(model.nu), spring_lengths(data, model.nu, model.nu))
    for _ in range(max_ticks):
        before = law.integral_kpa
        data.ctrl[:], law = control.pressures(
            reference_m, spring_lengths(data, model.nu, model.nu), law, gains, period_s
        )
        mujoco.mj_step(model, data, steps_per_tick)
        drift = np.abs(law.integral_kpa - before).max() / period_s
        # An acceleration settles long before a velocity; both are asked for.
        if max(np.abs(data.qvel).max(), np.abs(data.qacc).max(), 1e-3 * drift) < tolerance:
            break
    else:
        pytest.fail(f"C MuJoCo did not come to rest at {reference_m}")
    data.qvel[:] = 0.0
    mujoco.mj_forward(model, data)
    left = data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias
    tip = data.site("tip")
    return Rest(
        q=data.qpos.copy(),
        pressure_kpa=data.ctrl.copy(),
        spring_m=spring_lengths(data, model.nu, model.nu).copy(),
        tip_position_m=tip.xpos.copy(),
        tip_rotation=tip.xmat.reshape(3, 3).copy(),
        residual=np.abs(left).max(),
    )


@functools.cache
def truth(n, seed, spec=SPEC):
    """Rests of C MuJoCo at random references."""
    model, gains = fast_model(spec), FAST_GAINS._replace(allocation=control.allocation(spec))
    rests = [stepped_to_rest(model, reference, gains) for reference in references(n, seed, spec)]
    return Rest(*map(np.stack, zip(*rests, strict=True)))


@functools.cache
def settled(n, seed, spec=SPEC):
    """`settle` at the same references."""
    params = ArmParams.from_spec(spec)
    many = xla.jit(jax.vmap(lambda x: settle(params, x)))
    return jax.device_get(many(np.float32(references(n, seed, spec))))


def position_error_mm(a, b):
    return 1e3 * np.linalg.norm(a.tip_position_m - b.tip_position_m, axis=-1)


def angle_error_deg(a, b):
    chord = np.linalg.norm(a.tip_rotation - b.tip_rotation, axis=(-2, -1))
    return np.rad2deg(2.0 * np.arcsin(chord / np.sqrt(8.0)))


def test_neither_time_step_nor_damping_nor_gains_move_the_rest():
    model, fast = build_model(SPEC), truth(N, 0)
    steps = round(1.0 / (SPEC.control.rate_hz * model.opt.timestep))
    for k in range(3):
        own = stepped_to_rest(model, references(N, seed=0)[k], GAINS, steps, tolerance=1e-6)
        np.testing.assert_allclose(own.q, fast.q[k], atol=1e-5)
        np.testing.assert_allclose(own.tip_position_m, fast.tip_position_m[k], atol=2e-6)
        np.testing.assert_allclose(own.pressure_kpa, fast.pressure_kpa[k], atol=1e-2)


@pytest.mark.parametrize(
    "arm, n, seed",
    [
        ("paper", N, 0),
        pytest.param("paper", 4096, 1, marks=pytest.mark.slow),
        *((arm, 32, 0) for arm in OTHER_ARMS),
    ],
)
def test_the_settled_arm_is_where_c_mujoco_comes_to_rest(arm, n, seed):
    """Redundant chambers, too, whose pressures rest where the law takes them."""
    spec = OTHER_ARMS.get(arm, SPEC)
    reference, rest = references(n, seed, spec), truth(n, seed, spec)
    found, matrices = settled(n, seed, spec), control.allocation(spec)
    error_mm = position_error_mm(found, rest)
    saturated = (rest.pressure_kpa <= GAINS.pressure_min_kpa) | (rest.pressure_kpa >= GAINS.pressure_max_kpa)
    assert rest.residual.max() < 1e-6 and 0.2 < saturated.mean() < 0.8
    assert found.settled.mean() > 0.999
    assert error_mm[found.settled].max() < POSITION_MM / 10
    assert angle_error_deg(found, rest)[found.settled].max() < ANGLE_DEG / 10
    assert np.abs(found.spring_m - rest.spring_m)[found.settled].max() < 1e-5
    assert np.abs(found.pressure_kpa - rest.pressure_kpa)[found.settled].max() < 0.02
    off_m = reference - found.spring_m
    if matrices is not None:
        off_m = control.allocated_error(off_m, found.pressure_kpa, matrices)
    assert np.abs(off_m)[~saturated].max() < 0.2e-3
    np.testing.assert_array_equal(found.at_limit, saturated)
