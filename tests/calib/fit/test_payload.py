"""Effects of payloads: a tilt that S2R alone knows, and the factor that a known weight tells."""

import numpy as np
import pytest

from calib.arm import CalibratedArm
from calib.fit.held_pressures import fit_held_pressures, hysteresis_kpa
from calib.fit.payload import held_at, payload_poses, told_payload, weighed
from calib.read.static_poses import StaticPoses
from mjx_softarm import ArmSpec
from mjx_softarm.sensing.held_pressures import held_kpa
from mjx_softarm.sensing.load import COMMON_FACTOR
from mjx_softarm.sensing.pose import rotation_about
from mjx_softarm.sensing.s2r import N_POSE_INPUTS, N_POSE_OUTPUTS
from tests.networks import s2r_of

SPEC = ArmSpec.default()
TILT_DEG = 4.0, -3.0, 0.0


def s2r_of_a_tilt(tilt_deg, n_springs):
    """Return S2R of a base with a tilt: it shifts the tip in proportion to its place, and turns it."""
    vector_rad = np.radians(tilt_deg)
    weight = np.zeros((N_POSE_INPUTS + n_springs, N_POSE_OUTPUTS), np.float32)
    weight[:3, :3] = 1e3 * (rotation_about(vector_rad) - np.eye(3)).T
    angle = np.linalg.norm(vector_rad)
    gibbs = np.tan(angle / 2) * vector_rad / angle
    return s2r_of(((weight, np.float32([0, 0, 0, *gibbs])),), 1e6)


def test_a_tilt_that_s2r_knows_changes_the_effect_of_a_payload():
    rng = np.random.default_rng(2)
    spring_m = 0.2 + rng.uniform(-0.01, 0.03, (20, SPEC.n_springs))
    tilted = SPEC.replace(mounting={"base_turn_deg": TILT_DEG})
    arms = CalibratedArm(tilted), CalibratedArm(SPEC), CalibratedArm(SPEC, s2r_of_a_tilt(TILT_DEG, 9))
    (true, held), (without, _), (found, _) = (held_at(arm, spring_m) for arm in arms)
    assert held.all()
    off, left = (np.abs(at.effect_kpa_per_kg - true.effect_kpa_per_kg) for at in (without, found))
    # A tilted arm also bends in another way under its own weight. The network above leaves this out.
    assert off.mean() > 1.0 and left.mean() < 0.2 * off.mean()
    np.testing.assert_array_equal(found.pressure_kpa, without.pressure_kpa)


@pytest.fixture(scope="module")
def arm():
    """An arm with small residual pressures and some hysteresis."""
    at = payload_poses(CalibratedArm(SPEC), 60)
    left_kpa = 0.1 * np.random.default_rng(0).standard_normal(at.pressure_kpa.shape)
    fit = fit_held_pressures(SPEC, at.spring_m, at.pressure_kpa + left_kpa, at.pressure_kpa)
    return CalibratedArm(SPEC, held=fit.held._replace(hysteresis_kpa=np.full(3, 0.5)))


def poses_with(arm, factor, weight_kg, n, seed):
    """Poses with a weight, of an arm whose chambers answer to it by this factor."""
    at = payload_poses(arm, n, seed)
    true, effect_kpa = arm.held._replace(factor=factor, factor_sd=0.0), weight_kg * at.effect_kpa_per_kg
    kpa = held_kpa(true, at.spring_m, at.pressure_kpa, effect_kpa, np.random.default_rng(seed))
    kpa = kpa + hysteresis_kpa(SPEC, arm.held, at.spring_m)
    m, none = len(kpa), np.empty(0)
    return StaticPoses(kpa, np.full(m, weight_kg), none, none, at.spring_m, none, none, np.ones(m))


def test_poses_with_a_known_weight_tell_the_factor_of_all_payloads(arm):
    found = weighed(arm, poses_with(arm, 0.9, 0.5, 20, 3))
    held = found.held
    assert found.n == 20 and held.factor == pytest.approx(0.9, abs=0.02)
    assert held.factor_sd < 0.7 * COMMON_FACTOR
    # Another payload at other poses, told within intervals that are narrower
    poses = poses_with(arm, 0.9, 1.0, 40, 4)
    kpa = poses.pressure_kpa - hysteresis_kpa(SPEC, arm.held, poses.spring_m)
    before, then = (told_payload(arm._replace(held=x), poses.spring_m, kpa) for x in (arm.held, held))
    assert before[0].mean() == pytest.approx(0.9, abs=0.03)
    assert then[0].mean() == pytest.approx(1.0, abs=0.03) and then[1].mean() < 0.9 * before[1].mean()
    # The same poses tell the same, whatever factor was fitted before
    assert weighed(arm._replace(held=held), poses).ratio == pytest.approx(before[0].mean(), abs=0.01)


def test_hysteresis_is_no_weight(arm):
    """Chambers that shrank hold less."""
    poses = poses_with(arm, 1.0, 0.25, 20, 3)
    without = arm._replace(held=arm.held._replace(hysteresis_kpa=np.zeros(3)))
    assert abs(weighed(arm, poses).ratio - 1.0) < abs(weighed(without, poses).ratio - 1.0)


def test_a_weight_that_is_hardly_felt_tells_little_and_leaves_the_interval(arm):
    held = weighed(arm, poses_with(arm, 0.9, 0.005, 20, 3)._replace(payload_kg=np.full(20, 0.0055))).held
    assert 0.8 * COMMON_FACTOR < held.factor_sd <= COMMON_FACTOR and held.factor == pytest.approx(
        1.0, abs=0.04
    )


@pytest.mark.parametrize("weight_kg", [0.25, 5.0])
def test_a_weight_that_is_not_the_log_s_is_refused(arm, weight_kg):
    poses = poses_with(arm, 1.0, 0.5, 20, 3)
    found = weighed(arm, poses._replace(payload_kg=np.full(len(poses.payload_kg), weight_kg)))
    assert not found.is_plausible and found.held is arm.held


def test_redundant_pressures_are_no_weight(four_chamber_arm):
    at = payload_poses(CalibratedArm(four_chamber_arm), 40)
    rng, n = np.random.default_rng(0), four_chamber_arm.n_chambers
    left_kpa = 0.1 * rng.standard_normal(at.pressure_kpa.shape)
    fit = fit_held_pressures(four_chamber_arm, at.spring_m, at.pressure_kpa + left_kpa, at.pressure_kpa)
    push = np.repeat(rng.uniform(-5.0, 5.0, (len(left_kpa), n // 4)), 4, axis=1) * np.tile(
        [1.0, -1.0], n // 2
    )
    kpa, none = at.pressure_kpa + 0.5 * at.effect_kpa_per_kg, np.empty(0)
    m = len(kpa)
    poses = StaticPoses(kpa + push, np.full(m, 0.5), none, none, at.spring_m, none, none, np.ones(m))
    found = weighed(CalibratedArm(four_chamber_arm, held=fit.held), poses)
    assert found.ratio == pytest.approx(1.0, abs=0.05)
