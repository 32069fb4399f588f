"""Distillation: held-out errors, payloads, same networks from the same seed, chambers without pressure."""

from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from calib.arm import CalibratedArm
from calib.fit.held_pressures import fit_held_pressures
from calib.fit.payload import estimated_payload
from mjx_softarm import ArmSpec
from mjx_softarm.control import TOLERANCE_M, Gains, saturated
from mjx_softarm.deploy.belief import explained_by_pressure_loss
from mjx_softarm.mechanics.mjcf import build_model, spring_lengths
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import settle
from mjx_softarm.mechanics.workspace import HELD_OUT_SEED, sample_workspace
from mjx_softarm.sensing.estimator import POSE_ERROR_MM, estimate_frame, expected_springs
from mjx_softarm.sensing.load import estimate_load
from mjx_softarm.sensing.pose import frame_from_pose
from train.runs import arm_model
from train.runs.arm_model import PAYLOADS, distil, fit_load_estimator, fit_pose

SPEC = ArmSpec.default()
N, N_ARMS = SPEC.n_chambers, 512


@pytest.fixture(scope="module", autouse=True)
def small():
    """Fewer poses and updates than an export has."""
    sizes = {"N_TRAINING": 8192, "N_HELD_OUT": 512, "SCHEDULE": arm_model.SCHEDULE._replace(n_updates=2000)}
    with pytest.MonkeyPatch.context() as monkeypatch:
        for name, value in sizes.items():
            monkeypatch.setattr(arm_model, name, value)
        yield


@pytest.fixture(scope="module")
def distilled(small):
    return distil(CalibratedArm(SPEC))


@pytest.fixture(scope="module")
def pool():
    return jax.device_get(sample_workspace(SPEC, N_ARMS, 77))


def test_tips_are_those_of_c_mujoco(distilled, pool):
    model = build_model(SPEC)
    data = mujoco.MjData(model)
    away_mm = []
    for k in range(0, N_ARMS, 4):
        data.qpos[:] = pool.q[k]
        mujoco.mj_forward(model, data)
        frame = estimate_frame(
            distilled.model.estimator, spring_lengths(data, SPEC.n_chambers, SPEC.n_springs), 0.0
        )
        away_mm.append(1e3 * np.linalg.norm(frame.position_m - data.site("tip").xpos))
    assert np.median(away_mm) < 0.05 and max(away_mm) < 0.5
    assert np.median(away_mm) == pytest.approx(distilled.errors["tip_mm"]["0 kg"]["median"], rel=0.25)


def test_errors_are_given_by_payload(distilled, pool):
    for errors in distilled.errors.values():
        assert tuple(errors) == tuple(f"{payload_kg:g} kg" for payload_kg in PAYLOADS)
        assert all(0.0 < error["median"] < error["p95"] < error["largest"] for error in errors.values())
    unloaded = distilled.errors["spring_mm"]["0 kg"]["median"]
    off_m = np.abs(expected_springs(distilled.model.spring_model, pool.pressure_kpa) - pool.spring_m).max(1)
    assert 1e3 * np.median(off_m) == pytest.approx(unloaded, rel=0.25) and unloaded < 5.0
    medians = [error["median"] for error in distilled.errors["spring_mm"].values()]
    assert medians == sorted(medians)


@pytest.mark.parametrize("payload_kg", [0.3, 1.0])
def test_payload_is_estimated_and_then_the_pose(distilled, payload_kg):
    """Rests that C MuJoCo confirms elsewhere; the springs alone leave the tip some millimetres off."""
    spec = SPEC.replace(mass={"payload_kg": payload_kg})
    pool = jax.device_get(sample_workspace(spec, N_ARMS, 78))
    estimate_kg, _ = estimate_load(distilled.model.load_estimator, pool.spring_m, pool.pressure_kpa)
    assert np.mean(np.abs(estimate_kg - payload_kg)) < 0.08
    tip_m, _ = frame_from_pose(pool.pose)

    def off_mm(load_kg):
        frame = estimate_frame(distilled.model.estimator, pool.spring_m, load_kg)
        return 1e3 * np.median(np.linalg.norm(frame.position_m - tip_m, axis=1))

    assert off_mm(payload_kg) < 0.05 and off_mm(estimate_kg) < 1.0
    assert off_mm(0.0) > 1.5 * off_mm(estimate_kg)


def arms_at_rest(reference_m, payload_kg, dead):
    """Arms of unequal chambers under the law; `dead` (n_arms, n) of them have no pressure."""
    params = ArmParams.from_spec(SPEC.replace(mass={"payload_kg": payload_kg}))
    many = jax.tree.map(lambda x: np.broadcast_to(x, (N_ARMS, *np.shape(x))), params)
    spread = np.random.default_rng(8).uniform(0.9, 1.1, (2, N_ARMS, N)).astype(np.float32)
    many = many._replace(
        chamber_stiffness=many.chamber_stiffness * spread[0],
        area=many.area * spread[1],
        pressure_min_kpa=np.where(dead, 0.0, many.pressure_min_kpa).astype(np.float32),
        pressure_max_kpa=np.where(dead, 0.0, many.pressure_max_kpa).astype(np.float32),
    )
    end = jax.device_get(jax.jit(jax.vmap(settle))(many, reference_m))
    winds = np.where(reference_m > end.spring_m, params.pressure_max_kpa, params.pressure_min_kpa)
    return end, np.where(dead, winds, end.pressure_kpa)


def found(distilled, end, commanded_kpa, reference_m):
    spring_m = end.spring_m + 4e-5 * np.random.default_rng(9).standard_normal(end.spring_m.shape)
    gains = Gains.from_spec(SPEC)
    suspect = saturated(commanded_kpa, reference_m, spring_m, gains, TOLERANCE_M)
    rows = zip(commanded_kpa, spring_m, strict=True)
    return suspect & [explained_by_pressure_loss(distilled.model.spring_model, *row, gains) for row in rows]


@pytest.mark.parametrize("payload_kg", [0.0, 1.0])
def test_saturated_arms_are_not_taken_for_leaking(distilled, payload_kg):
    reference_m = np.random.default_rng(5).uniform(0.12, 0.26, (N_ARMS, N)).astype(np.float32)
    end, commanded_kpa = arms_at_rest(reference_m, payload_kg, np.zeros((N_ARMS, N), bool))
    full = saturated(commanded_kpa, reference_m, end.spring_m, Gains.from_spec(SPEC), TOLERANCE_M)
    assert full.any(axis=1).mean() > 0.9
    assert not found(distilled, end, commanded_kpa, reference_m).any()


def test_an_arm_without_air_is_found(distilled):
    reference_m = np.random.default_rng(7).uniform(0.14, 0.22, (N_ARMS, N)).astype(np.float32)
    end, commanded_kpa = arms_at_rest(reference_m, 0.0, np.ones((N_ARMS, N), bool))
    assert found(distilled, end, commanded_kpa, reference_m).any(axis=1).mean() > 0.95


@pytest.mark.parametrize(("payload_kg", "share"), [(0.0, 0.95), (0.5, 0.85)])
def test_lost_chambers_are_found(distilled, pool, payload_kg, share):
    chamber = np.random.default_rng(6).integers(0, N, N_ARMS)
    rows = np.arange(N_ARMS)
    dead = np.zeros((N_ARMS, N), bool)
    dead[rows, chamber] = True
    end, commanded_kpa = arms_at_rest(pool.spring_m, payload_kg, dead)
    matters = end.settled & (np.abs(pool.pressure_kpa[rows, chamber]) > 5.0)
    lost = found(distilled, end, commanded_kpa, pool.spring_m)
    assert lost[rows, chamber][matters].mean() > share
    assert not (lost & ~dead).any()


# An arm with a tilted base and a tip beside the plate, and one with more chambers.
MOUNTING = {
    "base_turn_deg": (3.0, -2.0, 5.0),
    "tip_turn_deg": (4.0, 0.0, 9.0),
    "tip_offset_m": (0.01, 0.0, -0.03),
}


@pytest.mark.parametrize("spec", [SPEC.replace(mounting=MOUNTING), ArmSpec.of(Path("four-chamber"))])
def test_poses_are_within_a_tenth_of_a_millimetre(spec):
    """Without a payload and with the largest."""
    estimator = fit_pose(spec)
    for payload_kg in (0.0, spec.mass.largest_payload_kg):
        held_out = sample_workspace(spec.replace(mass={"payload_kg": payload_kg}), 1024, HELD_OUT_SEED)
        tip_m, rotation = frame_from_pose(np.asarray(held_out.pose, float))
        frame = estimate_frame(estimator, held_out.spring_m, payload_kg)
        off_mm = 1e3 * np.linalg.norm(frame.position_m - tip_m, axis=1)
        assert np.quantile(off_mm, 0.95) < POSE_ERROR_MM
        turn = np.linalg.norm(frame.rotation - rotation, axis=(1, 2)) / np.sqrt(2)
        assert np.rad2deg(np.quantile(turn, 0.95)) < 0.05


def test_a_payload_is_estimated_within_its_interval_with_the_pressures_that_calibration_found(
    distilled, pool
):
    """Residual pressures are an offset, as older calibrations have it, and those of chambers that harden.

    A payload is felt as 0.9 of the simulated one.
    """
    spec = SPEC.replace(unmodelled={"pressure_kpa": tuple(np.random.default_rng(5).normal(0, 2, N))})

    def hardening(spring_m):
        return 40.0 * ((spring_m - 0.2) / 0.2) ** 2 * np.linspace(-1.0, 1.0, N)

    # Calibrate by half of the unloaded poses, and estimate payloads at the other half, and with a payload.
    rows, others = (jax.tree.map(lambda x, k=k: x[k::2], pool) for k in range(2))
    measured_kpa = rows.pressure_kpa + hardening(rows.spring_m)
    held = fit_held_pressures(spec, rows.spring_m, measured_kpa, rows.pressure_kpa).held
    arm = CalibratedArm(spec, held=held._replace(factor=0.9, factor_sd=0.03))
    found = fit_load_estimator(arm)
    assert found.factor_sd == pytest.approx(0.03)
    loaded = jax.device_get(sample_workspace(SPEC.replace(mass={"payload_kg": 0.45}), N_ARMS, 79))
    for arms, payload_kg in ((others, 0.0), (loaded, 0.5)):
        kpa = arms.pressure_kpa + hardening(arms.spring_m) + spec.unmodelled_kpa
        models = distilled.model.load_estimator, found
        told_kg, half_width_kg = np.array(
            [estimate_load(model, arms.spring_m, kpa) for model in models]
        ).swapaxes(0, 1)
        off_kg = np.abs(told_kg - payload_kg)
        assert np.median(off_kg[1]) < 0.08 and np.median(off_kg[0]) > 1.5 * np.median(off_kg[1])
        exact_kg, _ = estimated_payload(arm, arms.spring_m, kpa - spec.unmodelled_kpa)
        assert np.sqrt(np.mean((told_kg[1] - exact_kg) ** 2)) < 0.03  # 0.003 after all of the training
        assert np.mean(off_kg[1] < half_width_kg[1]) > 0.9 and np.median(half_width_kg[1]) < 0.3
