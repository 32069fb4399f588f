"""The observation of a moving arm against hand calculations."""

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.mdp.observation import motion_size, observe_motion

SPEC = ArmSpec.default()
LOW_M, HIGH_M = SPEC.springs.length_min_m, SPEC.springs.length_max_m


@pytest.mark.parametrize("to_library", [np.asarray, jnp.asarray])
def test_a_moving_arm_by_hand(to_library):
    spring = np.full(9, 0.5 * (LOW_M + HIGH_M))
    spring[:2] = LOW_M, HIGH_M
    last = spring - np.r_[0.002, np.zeros(8)]  # the first one grows by 2 mm in 20 ms
    tip, last_tip = np.array([0.0, 6.0, -600.0]), np.array([0.0, 0.0, -600.0])
    action = np.linspace(-1.0, 1.0, 9)
    given = (to_library(np.float32(x)) for x in (spring, last, tip, last_tip, action))
    observed = np.asarray(observe_motion(*given, SPEC))
    assert observed.shape == (motion_size(9),)
    np.testing.assert_allclose(observed[:9], [-1.0, 1.0, *np.zeros(7)], atol=1e-5)
    np.testing.assert_allclose(observed[9:18], [1.0, *np.zeros(8)], atol=1e-4)  # of 100 mm/s
    np.testing.assert_allclose(observed[18:21], [0.0, 1.0, 0.0], atol=1e-4)  # of 300 mm/s
    np.testing.assert_array_equal(observed[21:], np.float32(action))
