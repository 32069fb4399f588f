"""Settled arm and stepped C MuJoCo come to the same rest under the sensor-space law.

The truth is C MuJoCo with the law in the loop, stepped until nothing moves. A rest depends on neither the
time step nor the damping nor the law's gains, so the truth is taken with those that come to rest soonest, and
one test holds it against the arm's own.
"""

from typing import NamedTuple

import jax
import mujoco
import numpy as np
import pytest

from benchmarks.speed.truth import random_references
from mjx_softarm import ArmSpec, control
from mjx_softarm._support import xla
from mjx_softarm.mechanics.mjcf import build_model, spring_lengths
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import settle
from tests.arms import OTHER_ARMS

SPEC = ArmSpec.default()
GAINS = control.Gains.from_spec(SPEC)

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


def truth(reference_m, spec):
    """Rests of C MuJoCo at references (n, n_springs)."""
    model, gains = fast_model(spec), FAST_GAINS._replace(allocation=control.allocation(spec))
    rests = [stepped_to_rest(model, reference, gains) for reference in reference_m]
    return Rest(*map(np.stack, zip(*rests, strict=True)))


def test_neither_time_step_nor_damping_nor_gains_move_the_rest():
    model, reference_m = build_model(SPEC), random_references(SPEC, 3)
    steps = round(1.0 / (SPEC.control.rate_hz * model.opt.timestep))
    fast = truth(reference_m, SPEC)
    for k in range(3):
        own = stepped_to_rest(model, reference_m[k], GAINS, steps, tolerance=1e-6)
        np.testing.assert_allclose(own.q, fast.q[k], atol=1e-5)
        np.testing.assert_allclose(own.tip_position_m, fast.tip_position_m[k], atol=2e-6)
        np.testing.assert_allclose(own.pressure_kpa, fast.pressure_kpa[k], atol=1e-2)


@pytest.mark.parametrize(
    "arm, n",
    [("paper", 128), pytest.param("paper", 4096, marks=pytest.mark.slow), *((arm, 32) for arm in OTHER_ARMS)],
)
def test_the_settled_arm_is_where_c_mujoco_comes_to_rest(arm, n):
    """Redundant chambers, too, whose pressures rest where the law takes them."""
    spec = OTHER_ARMS.get(arm, SPEC)
    reference_m, params = random_references(spec, n), ArmParams.from_spec(spec)
    low, high = map(spec.at_springs, (spec.springs.length_min_m, spec.springs.length_max_m))
    corner = reference_m[: n // 4]  # the shortest and the longest that may be commanded
    reference_m[: n // 4] = np.where(corner < 0.5 * (low + high), low, high)
    rest = truth(reference_m, spec)
    found = jax.device_get(xla.jit(jax.vmap(lambda x: settle(params, x)))(np.float32(reference_m)))
    saturated = (rest.pressure_kpa <= GAINS.pressure_min_kpa) | (rest.pressure_kpa >= GAINS.pressure_max_kpa)
    assert rest.residual.max() < 1e-6 and 0.2 < saturated.mean() < 0.8
    assert found.settled.mean() > 0.999
    off_m = np.linalg.norm(found.tip_position_m - rest.tip_position_m, axis=-1)
    chord = np.linalg.norm(found.tip_rotation - rest.tip_rotation, axis=(-2, -1))
    angle_deg = np.rad2deg(2.0 * np.arcsin(chord / np.sqrt(8.0)))
    assert off_m[found.settled].max() < 1e-5 and angle_deg[found.settled].max() < 0.01
    assert np.abs(found.spring_m - rest.spring_m)[found.settled].max() < 1e-5
    assert np.abs(found.pressure_kpa - rest.pressure_kpa)[found.settled].max() < 0.02
    error_m = reference_m - found.spring_m
    error_m = control.allocated_error(error_m, found.pressure_kpa, control.allocation(spec))
    assert np.abs(error_m)[~saturated].max() < 0.2e-3
    np.testing.assert_array_equal(found.at_limit, saturated)
