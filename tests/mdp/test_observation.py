"""Observations of payload and motion against hand calculations."""

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.mdp.observation import OBS_SIZE, ObsScale, layouts, observe, observe_motion, observe_payload
from mjx_softarm.mdp.rewards import RewardConfig

SPEC = ArmSpec.default()
LOW_M, HIGH_M = SPEC.springs.length_min_m, SPEC.springs.length_max_m
LEAST_KPA, GREATEST_KPA = SPEC.chambers.pressure_min_kpa, SPEC.chambers.pressure_max_kpa


@pytest.mark.parametrize("to_library", [np.asarray, jnp.asarray])
def test_a_moving_arm_by_hand(to_library):
    spring = np.full(9, 0.5 * (LOW_M + HIGH_M))
    spring[:2] = LOW_M, HIGH_M
    last = spring - np.r_[0.002, np.zeros(8)]  # the first one grows by 2 mm in 100 ms
    tip, last_tip = np.array([0.0, 6.0, -600.0]), np.array([0.0, 0.0, -600.0])
    action = np.linspace(-1.0, 1.0, 9)
    integral = np.r_[LEAST_KPA, GREATEST_KPA, np.full(7, 0.5 * (LEAST_KPA + GREATEST_KPA))]
    given = (to_library(np.float32(x)) for x in (spring, last, tip, last_tip, integral, action))
    observed = np.asarray(observe_motion(*given, SPEC))
    assert observed.shape == (len(layouts(SPEC)["motion"]) - OBS_SIZE,)
    np.testing.assert_allclose(observed[:9], [-1.0, 1.0, *np.zeros(7)], atol=1e-5)
    np.testing.assert_allclose(observed[9:18], [0.2, *np.zeros(8)], atol=1e-4)  # of 100 mm/s
    np.testing.assert_allclose(observed[18:21], [0.0, 0.2, 0.0], atol=1e-4)  # of 300 mm/s
    np.testing.assert_allclose(observed[21:30], [-1.0, 1.0, *np.zeros(7)], atol=1e-6)
    np.testing.assert_array_equal(observed[30:], np.float32(action))


@pytest.mark.parametrize("to_library", [float, jnp.asarray])
def test_a_payload_is_observed_as_a_share_of_the_arm_s_largest(to_library):
    observed = observe_payload(to_library(0.35), SPEC)
    assert observed.dtype == np.float32
    np.testing.assert_allclose(observed, [0.35], rtol=1e-6)
    half = SPEC.replace(mass={"arm_kg": SPEC.mass.arm_kg / 2, "gripper_kg": SPEC.mass.gripper_kg / 2})
    np.testing.assert_allclose(observe_payload(to_library(0.35), half), [0.7], rtol=1e-6)
    assert observe_payload(np.zeros(3), SPEC).shape == (3, 1)
    assert layouts(SPEC)["payload"][OBS_SIZE:] == ("payload_kg",)


def test_a_policy_of_positions_does_not_see_angles_of_goals():
    rng, config = np.random.default_rng(0), RewardConfig(axes=(1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
    pose, goal = rng.uniform(-50.0, 50.0, (2, 6))
    seen = observe(pose, goal, ObsScale.from_spec(SPEC), config)
    other = observe(pose, np.append(goal[:3], rng.uniform(-90.0, 90.0, 3)), ObsScale.from_spec(SPEC), config)
    np.testing.assert_array_equal(seen, other)
    full = observe(pose, goal, ObsScale.from_spec(SPEC), RewardConfig())
    np.testing.assert_array_equal(seen[:9], full[:9])
