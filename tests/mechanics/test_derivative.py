"""The derivative of `settle` against finite differences in double precision, forward and in reverse."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.control import YIELD_M_PER_KPA
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import settle, settle_pressures
from mjx_softarm.mechanics.statics import statics
from tests.arms import FOUR_CHAMBERS, SHORT, SIX_CHAMBERS, TAPERED

SPEC = ArmSpec.default()
DIFFERENTIATED = {
    "tapered": TAPERED.replace(structure={"links_per_section": 1}),
    "four": FOUR_CHAMBERS.replace(structure={"n_sections": 1, "links_per_section": 2}),
    "six": SIX_CHAMBERS.replace(structure={"n_sections": 1, "links_per_section": 2}),
}
N = 128
pytestmark = pytest.mark.usefixtures("quick_compiler")
SEEN = ("q", "pressure_kpa", "spring_m", "tip_position_m", "tip_rotation")  # these have a derivative


def references(spec):
    """Spring lengths (N, n_springs) [m] that hold half of the chambers at a limit."""
    return np.random.default_rng(0).uniform(0.09, 0.285, (N, spec.n_springs))


def seen(found):
    return {name: getattr(found, name) for name in SEEN}


def equilibrium_of_set(params, reference, q, pressure, at_limit, at_high):
    """Fields of the equilibrium that holds the chambers `at_limit`, by dense Newton steps from near it."""
    limit = jnp.where(at_high, params.pressure_max_kpa, params.pressure_min_kpa)
    kinematics, n = chain_kinematics(params), len(pressure)
    allocated, redundant = params.allocation or (jnp.eye(n), jnp.zeros((n, n)))

    def equations(q, pressure):
        here = statics(kinematics(q), q, pressure, params)
        closed = allocated @ (here.springs.length - reference) + YIELD_M_PER_KPA * redundant @ pressure
        law = jnp.where(at_limit, pressure - limit, closed)
        return jnp.concatenate([here.gradient, law]), here

    def newton(_, iterate):
        q, pressure = iterate
        left, here = equations(q, pressure)
        push = -here.push_per_kpa.reshape(len(q), n)
        springs = jax.scipy.linalg.block_diag(*here.springs.jacobian)
        law = [jnp.where(at_limit[:, None], 0.0, allocated @ springs)]
        law += [jnp.where(at_limit[:, None], jnp.eye(n), YIELD_M_PER_KPA * redundant)]
        system = jnp.block([[jax.vmap(here.hessian.times)(jnp.eye(len(q))), push], law])
        step = jnp.linalg.solve(system, left)
        return q - step[: len(q)], pressure - step[len(q) :]

    q, pressure = jax.lax.fori_loop(0, 4, newton, (q, pressure))
    left, here = equations(q, pressure)
    frames = kinematics(q)
    fields = q, pressure, here.springs.length, frames.tip_position, frames.tip_rotation
    return dict(zip(SEEN, fields, strict=True)), jnp.max(jnp.abs(left))


def directions(spec):
    """Relative changes of the arm's parameters, and changes (N, n_springs) [m] of the references."""
    rng = np.random.default_rng(1)
    params = ArmParams.from_spec(spec, np.float64)
    arm = jax.tree.map(lambda x: rng.normal(size=np.shape(x)), params._replace(allocation=None))
    unchanged = jax.tree.map(np.zeros_like, params.allocation)
    return arm._replace(allocation=unchanged), 0.01 * rng.normal(size=(N, spec.n_springs))


@functools.cache
def comparison(spec):
    """Shares of the two directions -> settled arms, their derivative, and the quotient of differences."""
    arm, turn = directions(spec)

    def compare(shares, reference, turn):
        def moved(step):
            params = ArmParams.from_spec(spec, np.float64)
            params = jax.tree.map(lambda x, d: x * (1.0 + shares[1] * step * d), params, arm)
            return params, reference + shares[0] * step * turn

        found, slope = jax.jvp(lambda step: settle(*moved(step)), (jnp.zeros(()),), (jnp.ones(()),))
        at_high = found.pressure_kpa >= SPEC.chambers.pressure_max_kpa
        start, step = (found.q, found.pressure_kpa, found.at_limit, at_high), 1e-5
        signs = jnp.array([1.0, -1.0])
        ends, left = jax.vmap(lambda sign: equilibrium_of_set(*moved(sign * step), *start))(signs)
        quotient = jax.tree.map(lambda x: (x[0] - x[1]) / (2 * step), ends)
        return found, seen(slope), quotient, jnp.max(left)

    jitted = jax.jit(jax.vmap(compare, in_axes=(None, 0, 0)))

    @functools.cache
    def of(*shares):
        with jax.enable_x64(True):
            return jax.device_get(jitted(np.array(shares), references(spec), turn))

    return of


def relative_error(found, expected):
    """Largest error (N,) of each arm, in parts of its largest entry, or of 1e-4 if that is larger."""
    error, size = (np.abs(x).reshape(N, -1).max(axis=1) for x in (found - expected, expected))
    return error / np.maximum(size, 1e-4)


@pytest.mark.parametrize("shares", [(1.0, 0.0), (0.0, 1.0)], ids=["reference", "params"])
@pytest.mark.parametrize("arm", DIFFERENTIATED)
def test_the_derivative_is_that_of_finite_differences_at_the_same_active_set(arm, shares):
    found, slope, quotient, left = comparison(DIFFERENTIATED[arm])(*shares)
    assert found.settled.all() and left.max() < 1e-9
    assert 0.2 < found.at_limit.mean() < 0.6
    for name in SEEN:
        assert relative_error(slope[name], quotient[name]).max() < 1e-4, name
        assert np.abs(quotient[name]).max() > 1e-2


def test_held_pressures_have_the_derivative_of_finite_differences():
    with jax.enable_x64(True):
        params = ArmParams.from_spec(SHORT, np.float64)
        q_of = jax.jit(lambda pressure_kpa: settle_pressures(params, pressure_kpa).q)
        pressure_kpa, step_kpa = np.random.default_rng(3).uniform(-35.0, 15.0, 3), 0.01
        slope = jax.jacfwd(q_of)(pressure_kpa)  # (nv, 3)
        steps = step_kpa * np.eye(3)
        quotient = [(q_of(pressure_kpa + d) - q_of(pressure_kpa - d)) / (2 * step_kpa) for d in steps]
        np.testing.assert_allclose(slope.T, quotient, rtol=1e-5, atol=1e-9)


def test_reverse_mode_is_the_transpose_of_forward_mode():
    params, reference = ArmParams.from_spec(SHORT), np.float32(references(SHORT)[:8])
    rng = np.random.default_rng(2)
    direction = jax.tree.map(lambda x: np.float32(x * rng.normal(size=np.shape(x))), params)
    turn = np.float32(0.01 * rng.normal(size=reference.shape))

    def both(reference, turn):
        def fields(params, reference):
            return seen(settle(params, reference))

        primals, tangents = (params, reference), (direction, turn)
        _, push = jax.linearize(fields, *primals)
        forward, pull = push(*tangents), jax.linear_transpose(push, *primals)
        weight = jax.tree.map(lambda x: jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape), forward)
        return inner(weight, forward), inner(pull(weight), tangents)

    def inner(a, b):
        return sum(jnp.vdot(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))

    forward, reverse = jax.jit(jax.vmap(both))(reference, turn)
    np.testing.assert_allclose(reverse, forward, rtol=1e-3)


def test_an_arm_that_does_not_settle_has_a_zero_derivative():
    params = ArmParams.from_spec(SHORT.replace(backbone={"bending_stiffness_nm_per_rad": 1e-3}))
    reference = np.float32(references(SHORT)[:8])
    reference[3, 0] = np.nan

    def fields(reference, spring_rest_m):
        found = settle(params._replace(spring_rest_m=spring_rest_m), reference)
        return seen(found), found

    @functools.partial(jax.vmap, in_axes=(0, None))
    def slopes(*arguments):
        values, push, found = jax.linearize(fields, *arguments, has_aux=True)
        along, weights = (jax.tree.map(jnp.ones_like, x) for x in (arguments, values))
        return found, push(*along), jax.linear_transpose(push, *arguments)(weights)

    found, *slope = jax.jit(slopes)(reference, params.spring_rest_m)
    assert not found.settled[3] and found.settled.sum() < 7
    for x in jax.tree.leaves(slope):
        assert (x[~found.settled] == 0).all() and np.isfinite(x).all()
