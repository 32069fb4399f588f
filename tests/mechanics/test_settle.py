"""The settled arm: forces balance in C MuJoCo, the law is at rest, and what cannot settle says so."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks.speed.truth import random_references
from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import (
    MAX_ITERATIONS,
    RESIDUAL_TOLERANCE,
    TRACKING_TOLERANCE_M,
    SettleResult,
    settle,
)
from mjx_softarm.mechanics.workspace import settle_many
from tests.arms import OTHER_ARMS

SPEC = ArmSpec.default()
LOW_KPA, HIGH_KPA = SPEC.chambers.pressure_min_kpa, SPEC.chambers.pressure_max_kpa
ONE_SECTION = SPEC.replace(structure={"n_sections": 1})
N = 128  # arms a batch, always, so that little is compiled


solve_many = jax.jit(jax.vmap(lambda params, x: settle(params, x), in_axes=(None, 0)))


def settled(solve, target, spec=SPEC, params=None):
    """Settled arms, one for each row of targets, as NumPy arrays."""
    with jax.numpy_dtype_promotion("strict"):
        if solve is settle_many:
            return settle_many(spec, target)
        found = solve_many(ArmParams.from_spec(spec) if params is None else params, np.float32(target))
    return jax.tree.map(np.asarray, found)


def references(spec=SPEC):
    return random_references(spec, N)


def pressures(spec=SPEC, seed=0):
    return np.random.default_rng(seed).uniform(LOW_KPA, HIGH_KPA, (N, spec.n_chambers))


def imbalance(spec, found):
    """Largest force (N,) [N, N m] that C MuJoCo finds left on each standing arm."""
    model = build_model(spec)
    data = mujoco.MjData(model)
    left = []
    for q, pressure in zip(found.q, found.pressure_kpa, strict=True):
        data.qpos[:], data.ctrl[:], data.qvel[:] = q, pressure, 0.0
        mujoco.mj_forward(model, data)
        left.append(np.abs(data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias).max())
    return np.array(left)


LIGHT = {"arm_kg": 0.4, "gripper_kg": 0.05}
CHANGES = {
    "the paper's": {},
    "loaded": {"mass": {"payload_kg": 1.0}},
    "overloaded": {"mass": {"payload_kg": 50.0}},
    "one section of two links": {
        "structure": {"n_sections": 1, "links_per_section": 2},
        "chambers": {"bonded_share": 0.5},
    },
    "light, lies": {"mounting": {"base_turn_deg": (90.0, 0.0, 0.0)}, "mass": LIGHT},
    "uneven, tilted, rolled": {
        "mounting": {
            "base_turn_deg": (20.0, -10.0, 5.0),
            "section_roll_deg": (3.0, -2.0, 4.0),
            "tip_offset_m": (0.001, -0.002, 0.004),
        },
        "chambers": {
            "area_m2": tuple(1.62e-3 * (0.8 + 0.05 * k) for k in range(9)),
            "stiffness_n_per_m": tuple(506.7 * (1.2 - 0.05 * k) for k in range(9)),
            "length_offset_m": tuple(0.001 * (k - 4) for k in range(9)),
        },
    },
}
ARMS = {name: SPEC.replace(**changes) for name, changes in CHANGES.items()}


@pytest.mark.parametrize(
    "solve, targets, arm",
    [
        *((settle, references, arm) for arm in ARMS),
        *((settle_many, pressures, arm) for arm in ARMS | OTHER_ARMS),  # by references: test_fidelity.py
    ],
)
def test_c_mujoco_finds_the_settled_arm_in_balance(solve, targets, arm):
    spec = (ARMS | OTHER_ARMS)[arm]
    found = settled(solve, targets(spec), spec)
    assert found.settled.all()
    left = imbalance(spec, found)
    assert left.max() < RESIDUAL_TOLERANCE
    np.testing.assert_allclose(found.residual, left, atol=RESIDUAL_TOLERANCE / 4)


def test_half_the_chambers_at_a_limit_take_a_handful_of_steps():
    found = settled(settle, references())
    assert found.iterations.mean() < 4.5 and found.iterations.max() <= 7  # one of them finds that all is done


def test_the_springs_that_pressures_give_ask_for_these_pressures():
    pressure = 0.9 * pressures()  # within the limits
    there = settled(settle_many, pressure)
    back = settled(settle, there.spring_m)
    assert back.settled.all() and not back.at_limit.any()
    np.testing.assert_allclose(back.pressure_kpa, pressure, atol=0.02)
    np.testing.assert_allclose(back.q, there.q, atol=1e-4)


def test_pressures_beyond_the_limits_are_clipped_to_them():
    beyond = np.where(pressures() > -10.0, 60.0, -101.0)
    limit = np.clip(beyond, LOW_KPA, HIGH_KPA)
    clipped, at_limit = settled(settle_many, beyond), settled(settle_many, limit)
    np.testing.assert_array_equal(clipped.pressure_kpa, limit)
    np.testing.assert_array_equal(clipped.q, at_limit.q)
    assert clipped.settled.all()


def test_pressures_are_kept_where_the_springs_happen_to_be_at_rest():
    # A single link at rest has every spring at exactly its rest length, which is nothing to be tracked here.
    spec = SPEC.replace(structure={"n_sections": 1, "links_per_section": 1})
    pressure = np.random.default_rng(0).uniform(0.0, HIGH_KPA, (N, 3))
    found = settled(settle_many, pressure, spec)
    np.testing.assert_allclose(found.pressure_kpa, pressure, rtol=1e-6)
    assert found.settled.all()
    assert imbalance(spec, found).max() < RESIDUAL_TOLERANCE


def test_half_a_kilogram_moves_held_arms_by_as_much_as_the_page_of_limits_says():
    """Pressures before it from the middle three quarters of their range, so that no chamber meets a limit."""
    middle, share = 0.5 * (LOW_KPA + HIGH_KPA), 0.75
    loaded = SPEC.replace(mass={"payload_kg": 0.5})
    pressure = middle + share * (pressures() - middle)
    free = settled(settle_many, pressure)
    held, sagged = settled(settle, free.spring_m, loaded), settled(settle_many, pressure, loaded)

    def shift_mm(other):
        shift_m = np.linalg.norm(other.tip_position_m - free.tip_position_m, axis=1)
        return np.quantile(1e3 * shift_m, [0.5, 0.95])

    assert free.settled.all() and sagged.settled.all() and held.settled.all() and not held.at_limit.any()
    np.testing.assert_allclose(shift_mm(held), [2.0, 3.5], rtol=0.1)
    np.testing.assert_allclose(shift_mm(sagged), [17.0, 30.0], rtol=0.1)
    anywhere = settled(settle, settled(settle_many, pressures()).spring_m, loaded)
    assert anywhere.at_limit.any(axis=1).mean() > 0.5


@pytest.mark.parametrize("solve, targets", [(settle, references), (settle_many, pressures)])
def test_one_target_that_is_not_a_number_fails_alone(solve, targets):
    target = targets()
    good = settled(solve, target)
    target[5, 2] = np.nan
    found = settled(solve, target)
    others = np.arange(N) != 5
    assert found.result[5] == SettleResult.NOT_FINITE and found.settled[others].all()
    np.testing.assert_array_equal(found.q[others], good.q[others])


@pytest.mark.parametrize(
    "name", [name for name in ArmParams._fields if name not in ("bonded_share", "allocation")]
)
def test_parameters_that_are_not_numbers_settle_nothing(name):
    params = ArmParams.from_spec(SPEC)
    nothing = jax.tree.map(lambda x: np.full_like(x, np.nan), getattr(params, name))
    broken = params._replace(**{name: nothing})
    found = settled(settle, references(), params=broken)
    assert not found.settled.any()
    assert (found.iterations <= MAX_ITERATIONS).all()


IMPOSSIBLE = {
    "limp": {
        "chambers": {"stiffness_n_per_m": 1.0},
        "backbone": {"axial_stiffness_n_per_m": 1.0, "bending_stiffness_nm_per_rad": 0.01},
    },
    "chambers that buckle the backbone": {"backbone": {"bending_stiffness_nm_per_rad": 1e-3}},
    "pistons of three square decimetres": {"chambers": {"area_m2": 0.03}},
}


@pytest.mark.parametrize("solve, targets", [(settle, references), (settle_many, pressures)])
@pytest.mark.parametrize("arm", IMPOSSIBLE)
def test_an_impossible_arm_is_reported_not_raised(arm, solve, targets):
    spec = SPEC.replace(**IMPOSSIBLE[arm])
    found = settled(solve, targets(), spec)
    assert found.settled.mean() < 0.5
    assert set(found.result[~found.settled]) <= {SettleResult.OUT_OF_ITERATIONS, SettleResult.NOT_CONVEX}
    assert (found.iterations <= MAX_ITERATIONS).all()
    assert np.isfinite(found.q).all() and np.isfinite(found.tip_position_m).all()
    # The flag is right about every one of them, in both directions.
    left = imbalance(spec, found)
    assert (left[found.settled] < 2 * RESIDUAL_TOLERANCE).all()
    off = (left > RESIDUAL_TOLERANCE / 2) | (found.tracking_error_m > TRACKING_TOLERANCE_M / 2)
    assert off[~found.settled].all()


def softened(softer, reference_m, n_at_once=None):
    """Tip, and its change with the reference, of an arm that has springs, holes and a mount of its own."""
    params = ArmParams.from_spec(ARMS["one section of two links"])
    params = params._replace(
        chamber_stiffness=params.chamber_stiffness / softer,
        chamber_site_m=params.chamber_site_m * softer**0.1,
        mount=params.mount._replace(tip_offset_m=params.mount.tip_offset_m + 0.01 * softer),
    )
    found, change = jax.jvp(lambda x: settle(params, x, n_at_once), (reference_m,), (0.1 * reference_m,))
    return jnp.stack([found.tip_position_m, change.tip_position_m])


def test_many_arms_settle_as_each_does_alone_whatever_numbers_they_share():
    """Five arms, one of them in the last chunk of two; their numbers are NumPy's."""
    softer, target = np.float32([1.0, 1.1, 1.2, 1.3, 1.4]), np.float32(references(ONE_SECTION))[:5]

    def settle_all():
        own = jax.vmap(lambda x, y: softened(x, y, 2))(softer, target)
        shared = jax.vmap(lambda x: jax.vmap(lambda y: softened(x, y, 2))(target[:3]))(softer[:2])
        return own, shared

    own, shared = jax.jit(settle_all)()
    alone = jax.jit(softened)
    np.testing.assert_allclose(own, list(map(alone, softer, target)), atol=1e-6)
    expected = [[alone(x, y) for y in target[:3]] for x in softer[:2]]
    np.testing.assert_allclose(shared, expected, atol=1e-6)
    assert "scan" in str(jax.make_jaxpr(settle_all)())


def test_new_numbers_need_no_new_compilation():
    settled(settle, references())
    n_compiled = solve_many._cache_size()
    found = settled(settle, references()[::-1], SPEC.replace(mass={"payload_kg": 0.1}))
    assert found.settled.all()
    assert solve_many._cache_size() == n_compiled
