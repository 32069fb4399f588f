"""Lags of an arm's springs, against closed forms."""

import numpy as np

from mjx_softarm.policy.lag import law_lag_s, spring_lag_s
from tests.linear_arm import GAIN_M_PER_KPA, POLICY, SPEC, N


def test_the_lag_of_springs_is_that_of_the_law_s_integral():
    lag_s = spring_lag_s(POLICY, np.zeros(N))
    np.testing.assert_allclose(lag_s @ (SPEC.control.ki_kpa_per_ms * GAIN_M_PER_KPA), np.eye(N), atol=1e-4)


def test_a_rough_response_of_the_springs_counts_by_its_mean_over_many_pressures():
    """A ripple with a period of 25 kPa changes the slope by a third at a point."""
    smooth = spring_lag_s(POLICY, np.zeros(N))
    rough = law_lag_s(
        POLICY.gains, lambda kpa: (kpa + 4.0 / 3.0 * np.sin(kpa / 4.0)) @ GAIN_M_PER_KPA.T, np.zeros(N)
    )
    np.testing.assert_allclose(rough, smooth, atol=0.03 * abs(smooth).max())
