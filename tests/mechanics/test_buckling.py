"""Arms that stand: what buckles says so, and what the law holds is where C MuJoCo's arm comes to rest."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.speed.mujoco_arms import SteppedArms
from benchmarks.speed.truth import random_references
from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import SettleResult, settle
from mjx_softarm.mechanics.statics import statics
from mjx_softarm.mechanics.workspace import sample_loaded, settle_many

pytestmark = pytest.mark.usefixtures("quick_compiler")
N = 16
UP = {"base_turn_deg": (180.0, 0.0, 0.0)}
# It stands by itself; with 10 g it buckles at half of all pressures, with 30 g at nearly all.
STANDING = ArmSpec.of(Path("stiff-flop")).replace(mounting=UP)


def loaded(payload_kg):
    return STANDING.replace(mass={"payload_kg": payload_kg})


def least_curvature(spec, found):
    """The least eigenvalue of the potential's Hessian at constant pressures, by the joints' own stiffness."""
    params = ArmParams.from_spec(spec, np.float64)
    root = np.sqrt(params.joint_stiffness)

    def curvature(q, pressure):
        at = statics(chain_kinematics(params)(q), q, pressure, params)
        hessian = jax.vmap(at.hessian.times)(jnp.eye(len(q)))
        return jnp.linalg.eigvalsh(hessian / root / root[:, None])[0]

    with jax.enable_x64(True):
        return jax.device_get(
            jax.jit(jax.vmap(curvature))(np.float64(found.q), np.float64(found.pressure_kpa))
        )


solve = jax.jit(jax.vmap(settle, in_axes=(None, 0)))


def settled(spec, reference_m):
    return jax.device_get(solve(ArmParams.from_spec(spec), np.float32(reference_m)))


def test_no_arm_that_would_buckle_settles_at_constant_pressures():
    spec = loaded(0.01)
    rng = np.random.default_rng(0)
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    pressures = np.vstack([np.zeros((1, 9)), rng.uniform(low, high, (127, 9))])
    found = settle_many(spec, pressures)
    assert found.result[0] == SettleResult.NOT_CONVEX
    assert 0.2 < found.settled.mean() < 0.9
    assert (least_curvature(spec, found)[found.settled] > 0.0).all()


def test_the_law_holds_arms_that_would_buckle_where_c_mujoco_holds_them():
    spec = loaded(0.01)
    reference_m = random_references(spec, N)
    found = settled(spec, reference_m)
    assert found.settled.all()
    assert (least_curvature(spec, found) < 0.0).mean() > 0.3
    arms = SteppedArms(spec, N, 1)
    for _ in range(round(12.0 * spec.control.rate_hz)):
        arms.tick(reference_m)
    assert np.linalg.norm(found.tip_position_m - arms.tip_m, axis=1).max() < 5e-5


def test_the_paper_s_arm_is_too_heavy_to_stand_and_says_so():
    spec = ArmSpec.default().replace(mounting=UP)
    found = settled(spec, random_references(spec, N))
    assert set(found.result) <= {SettleResult.NOT_CONVEX, SettleResult.OUT_OF_ITERATIONS}


def test_derivatives_of_arms_that_the_law_holds_are_those_of_differences():
    """By the references, and by the chambers' stiffness."""
    with jax.enable_x64(True):
        params = jax.tree.map(jnp.asarray, ArmParams.from_spec(loaded(0.03), np.float64))
        reference_m = jnp.asarray(random_references(STANDING, 4))

        def tips(change):
            """Arms whose references [mm] and stiffnesses [%] change by (2, 9)."""
            arm = params._replace(chamber_stiffness=params.chamber_stiffness * (1.0 + 0.01 * change[1]))
            hold = functools.partial(settle, arm)
            return jax.vmap(hold)(reference_m + 1e-3 * change[0])

        @jax.jit
        @jax.vmap
        def along(change, direction):
            return jax.jvp(tips, (change,), (direction,))

        # Both directions; arms without a change, and a step ahead and back along each
        direction, step = jnp.eye(2)[:, :, None] * np.random.default_rng(1).normal(size=9), 1e-4
        change = jnp.concatenate([jnp.zeros((2, 2, 9)), step * direction, -step * direction])
        arms, slopes = along(change, jnp.concatenate(3 * [direction]))
        found = jax.tree.map(lambda x: x[0], arms)
        curved = least_curvature(loaded(0.03), found)
        slope = slopes.tip_position_m[:2]  # (2, 4, 3)
        expected = (arms.tip_position_m[2:4] - arms.tip_position_m[4:]) / (2 * step)
    assert found.settled.any() and not (curved[found.settled] > 0.0).any()
    np.testing.assert_allclose(slope[:, found.settled], expected[:, found.settled], rtol=1e-3, atol=1e-6)
    assert (np.abs(slope).max(axis=(1, 2)) > 3e-5).all()  # [m] by a millimetre, by a percent


def test_arms_that_stand_are_drawn_with_payloads_under_which_they_would_buckle():
    pool = sample_loaded(STANDING, np.full(2 * N, 0.02), 0.0, seed=0)
    found = settled(loaded(0.02), pool.spring_m)
    assert found.settled.mean() > 0.8
    away_mm = 1e3 * found.tip_position_m - np.asarray(pool.pose)[:, :3]
    assert np.abs(away_mm[found.settled]).max() < 0.1
    assert (least_curvature(loaded(0.02), found)[found.settled] < 0.0).mean() > 0.3


def test_the_law_holds_no_arm_behind_regulators(spec):
    regulator = {"kind": "regulator", "lag_s": 0.3, "dead_time_s": 0.1, "deadband_kpa": 0.0}
    rates = {"fill_kpa_per_s": 100.0, "vent_kpa_per_s": 100.0}
    assert (ArmParams.from_spec(spec).law_stiffness > 0).all()
    assert not ArmParams.from_spec(spec.replace(actuators=regulator | rates)).law_stiffness.any()
