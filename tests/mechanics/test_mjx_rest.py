"""MJX's forces, tip and springs at rest against C MuJoCo, and its verdict on equilibria that are none."""

import jax
import mujoco
import numpy as np
import pytest

from benchmarks.speed.truth import random_references
from mjx_softarm._support import xla
from mjx_softarm._support.lazy import put
from mjx_softarm.mechanics.mjcf import build_model, spring_lengths
from mjx_softarm.mechanics.mjx_rest import measured
from mjx_softarm.mechanics.params import PAYLOAD, ArmParams
from mjx_softarm.mechanics.settle import RESIDUAL_TOLERANCE, SettleResult, settle
from mjx_softarm.spec import ArmSpec
from tests.arms import SHORT

N = 64
BONDED = SHORT.replace(chambers={"bonded_share": 0.6})
LOADED_KG, STIFFER = 0.3, 1.1


@pytest.fixture(scope="module", params=[BONDED, pytest.param(ArmSpec.default(), marks=pytest.mark.slow)])
def at_rest(request):
    """Loaded arms at random references: many of their chambers are at a limit."""
    spec = request.param
    params = ArmParams.from_spec(spec)
    params = params._replace(tool_mass_kg=np.float32(params.tool_mass_kg)).stiffened(np.float32(STIFFER))
    params.tool_mass_kg[PAYLOAD] = LOADED_KG
    solve = jax.vmap(lambda r: settle(params, r))
    proposed = xla.jit(solve)(np.float32(random_references(spec, N)))
    assert proposed.settled.all() and np.asarray(proposed.at_limit).any(axis=1).mean() > 0.25
    model, data = put(build_model(spec))
    measure = xla.jit(jax.vmap(lambda p: measured(model, data, params, p)))
    return spec, params, proposed, measure


def test_mjx_balances_where_the_closed_form_settles(at_rest):
    _, _, proposed, measure = at_rest
    end = measure(proposed)
    assert end.settled.all() and float(np.max(end.residual)) < 0.5 * RESIDUAL_TOLERANCE
    # An evaluation and a pool of goals by the closed form are those of MJX
    np.testing.assert_allclose(end.tip_position_m, proposed.tip_position_m, atol=1e-6)
    np.testing.assert_allclose(end.tip_rotation, proposed.tip_rotation, atol=1e-5)
    np.testing.assert_allclose(end.spring_m, proposed.spring_m, atol=1e-6)


def test_forces_tip_and_springs_are_those_of_c_mujoco(at_rest):
    """Off the equilibrium forces are left, by the masses and stiffnesses of the episode."""
    spec, _, proposed, measure = at_rest
    off = np.random.default_rng(1).normal(0.0, 0.01, proposed.q.shape)
    q = np.float32(proposed.q + off)
    end = measure(proposed._replace(q=q))
    stiffness = STIFFER * spec.chambers.stiffness_n_per_m
    model = build_model(
        spec.replace(mass={"payload_kg": LOADED_KG}, chambers={"stiffness_n_per_m": stiffness})
    )
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    data = mujoco.MjData(model)
    for k in range(8):
        data.qpos[:], data.ctrl[:] = q[k], proposed.pressure_kpa[k]
        mujoco.mj_forward(model, data)
        left = np.abs(data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias).max()
        np.testing.assert_allclose(end.residual[k], left, rtol=1e-3)
        assert left > RESIDUAL_TOLERANCE
        np.testing.assert_allclose(end.tip_position_m[k], data.site("tip").xpos, atol=1e-6)
        np.testing.assert_allclose(
            end.spring_m[k], spring_lengths(data, spec.n_chambers, spec.n_springs), atol=1e-6
        )


def test_what_does_not_balance_is_invalid_by_its_name(at_rest):
    _, _, proposed, measure = at_rest
    pressure = np.array(proposed.pressure_kpa)
    pressure[0, 0] += 1.0  # a kilopascal that the arm does not answer
    pressure[1, 0] = np.nan
    failed = np.array(proposed.result)
    failed[2] = SettleResult.OUT_OF_ITERATIONS.value
    end = measure(proposed._replace(pressure_kpa=pressure, result=failed))
    unbalanced, unsettled = SettleResult.UNBALANCED.value, SettleResult.OUT_OF_ITERATIONS.value
    np.testing.assert_array_equal(end.result[:4], [unbalanced, unbalanced, unsettled, 0])
