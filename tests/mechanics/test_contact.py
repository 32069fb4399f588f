"""Contact with a pipe: its energy and derivatives, arms that lean on the wall at rest and in motion."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial import cKDTree

from mjx_softarm import ArmSpec, control
from mjx_softarm._support import xla
from mjx_softarm._support.lazy import put
from mjx_softarm.mechanics.contact import (
    JAMMED_M,
    RAMP_M,
    STIFFNESS_N_PER_M,
    ball_centres,
    ball_forces,
    pipe_distance,
)
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.motion import midpoint
from mjx_softarm.mechanics.motion.state import Motion, MotionParams, MovingArm
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.pipe import Contact, CrossPipe, clearance
from mjx_softarm.mechanics.settle import MAX_ITERATIONS_IN_CONTACT, RESIDUAL_TOLERANCE, SettleResult, settle
from mjx_softarm.mechanics.statics import statics

SPEC = ArmSpec.default()
PIPE = CrossPipe.of_mm(250.0)
CONTACT = Contact.of(PIPE, SPEC)
R, Z = PIPE.radius_m, PIPE.centre_z_m
N = 128
pytestmark = pytest.mark.usefixtures("quick_compiler")


def params_of(dtype=np.float32, contact=CONTACT):
    return ArmParams.from_spec(SPEC, dtype)._replace(contact=contact)


def references(seed=0, spread_m=0.06):
    """Spring lengths (N, 9) [m] of crooked arms; most lean on the wall."""
    middle = np.random.default_rng(seed).uniform(0.14, 0.22, (N, 1))
    return np.clip(
        middle + np.random.default_rng(seed + 1).uniform(-spread_m, spread_m, (N, 9)), 0.085, 0.275
    )


@functools.cache
def settled():
    """Arms at rest in the pipe, single precision, and the force (N, 3, k) of the wall on each ball."""

    def one(reference):
        params = params_of()
        kinematics = chain_kinematics(params)
        found = settle(params, reference)
        return found, ball_forces(CONTACT, kinematics(found.q))

    return jax.tree.map(np.asarray, xla.jit(jax.vmap(one))(np.float32(references())))


def energy(q):
    """Energy of the contact by its definition: the integral of each ball's force over its depth."""
    centre = ball_centres(CONTACT, chain_kinematics(params_of(np.float64))(q))
    depth = jnp.maximum(jnp.array(CONTACT.radius_m) - pipe_distance(PIPE, centre), 0.0)
    ramp = jnp.minimum(depth, RAMP_M)
    beyond = (depth - ramp) * (depth + ramp - RAMP_M) / 2
    return STIFFNESS_N_PER_M * jnp.sum(ramp**3 / (6 * RAMP_M) + beyond)


def test_the_distance_to_the_wall_is_that_to_its_nearest_point():
    """Among points on both cylinders, 1.5 mm apart; the wedge leaves out the curvature of their edge."""
    along, angle = np.meshgrid(np.arange(-0.25, 0.25, 0.0015), np.arange(0, 2 * np.pi, 0.012))
    across, y = R * np.cos(angle), R * np.sin(angle)
    both = [np.stack(at, -1).reshape(-1, 3) for at in ((across, y, along), (along, y, across))]
    wall = np.concatenate(both) + [0.0, 0.0, Z]
    point = [0.0, 0.0, Z] + np.random.default_rng(0).uniform(-0.17, 0.17, (3000, 3))
    point = point[clearance(PIPE, point) > 0.02]
    expected, _ = cKDTree(wall[clearance(PIPE, wall) < 1e-9]).query(point)
    off = np.abs(pipe_distance(PIPE, jnp.array(point.T)) - expected)[expected < 0.075]  # rings: 69 mm
    assert len(off) > 500 and np.quantile(off, 0.97) < 2e-3 and off.max() < 5e-3


@pytest.mark.parametrize("diameter_mm", [200.0, 300.0])
def test_the_distance_has_a_continuous_gradient(diameter_mm):
    """Along lines through the crossing, on which the nearest wall changes; rings are 69 mm wide."""
    pipe, rng = CrossPipe.of_mm(diameter_mm), np.random.default_rng(1)
    start, way = rng.uniform(-0.5, 0.5, (2, 200, 3)) * pipe.diameter_m + [[[0.0, 0.0, Z]], [[0.0, 0.0, 0.0]]]
    at = np.moveaxis(start[:, None] + np.linspace(0.0, 1.0, 4001)[:, None] * way[:, None], -1, 0)
    with jax.enable_x64(True):
        distance = np.asarray(pipe_distance(pipe, jnp.array(at)))
        slope = np.asarray(jax.grad(lambda p: pipe_distance(pipe, p).sum())(jnp.array(at)))
    near = (distance > 0.03) & (distance < 0.072)
    assert np.isfinite(slope).all() and near.sum() > 1000
    assert np.linalg.norm(slope, axis=0)[near].max() < 1.35  # 1, but for the curvature
    jump = np.linalg.norm(np.diff(slope, axis=2), axis=0)
    assert jump[near[:, 1:] & near[:, :-1]].max() < 2e-3


@pytest.mark.parametrize("seed", range(3))
def test_gradient_and_hessian_are_the_derivatives_of_the_energy(seed):
    rng = np.random.default_rng(seed)
    q = (rng.normal(0, [0.01, 0.12, 0.12], (12, 3)) + rng.normal(0, [0.005, 0.05, 0.05], 3)).ravel()
    with jax.enable_x64(True):

        @jax.jit
        def both(q):
            found = [
                statics(chain_kinematics(params)(q), q, jnp.zeros(9), params)
                for params in (params_of(np.float64), params_of(np.float64, None))
            ]
            own = [(here.gradient, here.hessian.dense()) for here in found]
            columns = jnp.ones((3, 12, 1))
            return own, jax.grad(energy)(q), jax.hessian(energy)(q), found[0].hessian.solve(columns)

        ((gradient, hessian), (free, free_hessian)), slope, curve, _ = jax.device_get(both(jnp.array(q)))
    assert np.abs(slope).max() > 10.0
    np.testing.assert_allclose(gradient - free, slope, atol=1e-9 * np.abs(slope).max())
    np.testing.assert_allclose(hessian - free_hessian, curve, atol=1e-9 * np.abs(curve).max())


def test_nearly_all_arms_come_to_rest_and_the_others_say_why():
    found, force = settled()
    known = {SettleResult.OUT_OF_ITERATIONS, SettleResult.NOT_CONVEX}
    assert found.settled.mean() > 0.85
    assert set(found.result[~found.settled].tolist()) <= known
    leaning = np.linalg.norm(force, axis=1).sum(axis=1)[found.settled] > 0.1  # [N]
    assert leaning.mean() > 0.5 and found.iterations.max() <= MAX_ITERATIONS_IN_CONTACT


def test_c_mujoco_finds_the_leaning_arm_in_balance():
    """With the wall's forces on the balls, pushed through MuJoCo's own Jacobians."""
    found, force = settled()
    model = build_model(SPEC)
    data, left = mujoco.MjData(model), []
    centre_of = jax.jit(jax.vmap(lambda q: ball_centres(CONTACT, chain_kinematics(params_of())(q))))
    for q, kpa, push, centre in zip(found.q, found.pressure_kpa, force, centre_of(found.q), strict=True):
        data.qpos[:], data.ctrl[:], data.qvel[:] = q, kpa, 0.0
        mujoco.mj_forward(model, data)
        total = data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias
        for plate, newton, at in zip(CONTACT.plate, push.T, np.asarray(centre).T, strict=True):
            body = model.body(f"link{plate - 1}").id
            mujoco.mj_applyFT(model, data, newton.astype(float), np.zeros(3), at.astype(float), body, total)
        left.append(np.abs(total).max())
    left = np.array(left)[found.settled]
    assert left.max() < 2 * RESIDUAL_TOLERANCE


def test_the_wall_holds_the_arm():
    """Some arms would be centimetres outside without it; within it no ball is deeper than 3 mm."""
    found, _ = settled()

    def depth_m(q):
        centre = ball_centres(CONTACT, chain_kinematics(params_of())(q))
        return jnp.max(jnp.array(CONTACT.radius_m) - pipe_distance(PIPE, centre))

    def free(reference):
        params = params_of(contact=None)
        return settle(params, reference).q

    outside_m = jax.jit(jax.vmap(lambda r: depth_m(free(r))))(np.float32(references()))
    inside_m = np.asarray(jax.jit(jax.vmap(depth_m))(found.q))
    assert np.quantile(outside_m, 0.75) > 0.02
    assert np.quantile(inside_m[found.settled], 0.95) < 3e-3
    assert inside_m[found.settled].max() < JAMMED_M


def test_the_implicit_derivative_is_along_central_differences():
    """By the references, of a position of the tip: each leaning arm that keeps its active set.

    An arm that jumps from one equilibrium to another has no derivative there.
    """
    n, step_m = 32, 1e-4
    weight = jnp.array([0.6, -0.5, 0.7])

    with jax.enable_x64(True):
        params = params_of(np.float64)

        def along(reference):
            found = settle(params, reference)
            return jnp.sum(weight * found.tip_position_m), found

        gradient = jax.jit(jax.vmap(jax.grad(along, has_aux=True)))
        reference = references()[:n]
        slope, found = jax.device_get(gradient(reference))
        shift = step_m * np.concatenate([np.eye(9), -np.eye(9)])
        ends, at = jax.device_get(jax.jit(jax.vmap(along))((reference[:, None] + shift).reshape(-1, 9)))
    ahead, behind = np.moveaxis(ends.reshape(n, 2, 9), 1, 0)
    quotient = (ahead - behind) / (2 * step_m)
    leaning = np.linalg.norm(settled()[1][:n], axis=1).sum(axis=1) > 0.1  # [N]
    kept = at.settled & (at.at_limit == np.repeat(found.at_limit, 18, axis=0)).all(axis=1)
    moved_m = np.linalg.norm(at.tip_position_m - np.repeat(found.tip_position_m, 18, axis=0), axis=1)
    known = found.settled & leaning & (kept & (moved_m < 20 * step_m)).reshape(n, 18).all(axis=1)
    slope, quotient = slope[known], quotient[known]
    lengths = np.linalg.norm(slope, axis=-1) * np.linalg.norm(quotient, axis=-1)
    cosine = np.sum(slope * quotient, -1) / lengths
    assert known.sum() > 10 and cosine.min() > 0.99


def test_an_arm_in_motion_comes_to_rest_where_it_settles():
    """Half-second actions until rest; the wall's energy takes part in the linearised step."""
    found, force = settled()
    push = np.linalg.norm(force, axis=1).sum(axis=1)
    chosen = np.flatnonzero(found.settled & (push > 1.0))[:8]
    model, data = put(build_model(SPEC), False)
    params, gains = params_of(), control.Gains.from_spec(SPEC)
    reference = np.float32(references()[chosen])

    def go(reference):
        arm = MovingArm(model, data, jax.tree.map(jnp.asarray, params), MotionParams())
        begin = settle(params, params.spring_rest_m)
        motion = Motion.at_rest(begin.q, begin.pressure_kpa, begin.spring_m)
        motion, end = midpoint.advance(arm, motion, reference, gains, 8.0, 0.02, 0.02)
        return end, jnp.linalg.norm(ball_forces(CONTACT, chain_kinematics(params)(motion.q)), axis=0).sum()

    end, force_n = xla.jit(jax.vmap(go))(reference)
    off_mm = 1e3 * np.linalg.norm(end.tip_position_m - found.tip_position_m[chosen], axis=-1)
    assert (end.result == 0).all() and off_mm.max() < 0.1
    np.testing.assert_allclose(force_n, push[chosen], atol=0.01)
