"""Lags of a moving arm: closed forms, and a pose that goes on after the springs."""

import numpy as np

from mjx_softarm.policy.lag import ShapeLag, spring_lag_s
from mjx_softarm.sensing.estimator import Frame, even_pose
from tests.linear_arm import DT_S, GAIN_M_PER_KPA, POLICY, SPEC, SPRINGS_M, N


def test_the_lag_of_springs_is_that_of_the_law_s_integral():
    lag_s = spring_lag_s(POLICY, np.zeros(N))
    np.testing.assert_allclose(lag_s @ (SPEC.control.ki_kpa_per_ms * GAIN_M_PER_KPA), np.eye(N), atol=1e-4)


def test_the_shape_lags_by_the_time_constant_of_the_backbone_and_is_at_rest_with_the_springs():
    own, spring_m = POLICY.estimator, SPRINGS_M[0]
    even = even_pose(Frame(own.base_position_m, own.base_rotation), own.spring_site_m, spring_m)
    speed = np.array([30.0, -20.0, 10.0, 5.0, 0.0, -5.0])  # [mm/s, deg/s] of what the springs do not show
    shape, lag_s = ShapeLag(), SPEC.backbone.shape_lag_s
    assert not shape.behind(POLICY, spring_m, even).any()
    for k in range(round(8.0 * lag_s / DT_S)):
        pose = even + k * DT_S * speed
        shape = shape.after(POLICY, spring_m, pose, DT_S)
    np.testing.assert_allclose(shape.behind(POLICY, spring_m, pose), lag_s * speed, rtol=1e-3, atol=1e-3)
    for _ in range(round(12.0 * lag_s / DT_S)):
        shape = shape.after(POLICY, spring_m, pose, DT_S)
    np.testing.assert_allclose(shape.behind(POLICY, spring_m, pose), 0.0, atol=1e-3)
