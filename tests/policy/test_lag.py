"""Lags of a moving arm: closed forms, and a pose that goes on after the springs."""

import dataclasses

import numpy as np
import pytest

from mjx_softarm.policy.lag import ShapeLag, law_lag_s, spring_lag_s
from mjx_softarm.sensing.estimator import estimate_frame
from mjx_softarm.sensing.s2r import inputs
from tests.linear_arm import DT_S, GAIN_M_PER_KPA, POLICY, SPEC, N, moves_aside
from tests.networks import s2r_of


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


@pytest.mark.parametrize("load_kg", [0.0, 1.0])
@pytest.mark.parametrize("corrected", [False, True])
def test_the_shape_lags_by_the_time_constant_of_the_backbone_and_is_at_rest_with_the_springs(
    load_kg, corrected
):
    """The payload doubles what lags; a sim-to-real network that turns with the springs does not lag."""
    policy = moves_aside(POLICY)
    if corrected:
        straight_m = np.full(N, SPEC.geometry.section_length_m, np.float32)
        n_in = len(inputs(estimate_frame(policy.estimator, straight_m, 0.0), straight_m))
        layers = ((np.full((n_in, 6), 0.1, np.float32), np.zeros(6, np.float32)),)
        policy = dataclasses.replace(policy, s2r=s2r_of(layers, 0.1))
    lag_s, rate_m_per_s = SPEC.shape_lag_s, 5e-3 * (np.arange(N) == N - 1)
    start_m = np.full(N, SPEC.geometry.section_length_m)  # the straight arm, whose plates are level
    shape, behind = ShapeLag().after(policy, start_m, load_kg, DT_S)
    assert not behind.any()
    for k in range(1, round(8.0 * lag_s / DT_S)):
        spring_m = start_m + k * DT_S * rate_m_per_s
        shape, behind = shape.after(policy, spring_m, load_kg, DT_S)
    expected_mm = 2.5 * (1.0 + load_kg) * lag_s  # 5 mm/s of the spring
    np.testing.assert_allclose(behind, [expected_mm, 0.0, 0.0, 0.0, 0.0, 0.0], rtol=1e-3, atol=2e-3)
    for _ in range(round(12.0 * lag_s / DT_S)):
        shape, behind = shape.after(policy, spring_m, load_kg, DT_S)
    np.testing.assert_allclose(behind, 0.0, atol=1e-3)
