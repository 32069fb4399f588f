"""Lags of a moving arm: closed forms, and a pose that goes on after the springs."""

import dataclasses

import numpy as np

from mjx_softarm.deploy.strategy import WayError
from mjx_softarm.policy.lag import ShapeLag, spring_lag_s
from tests.linear_arm import CONTROLLER, DT_S, GAIN_M_PER_KPA, POLICY, SPEC, N


def test_the_lag_of_springs_is_that_of_the_law_s_integral():
    lag_s = spring_lag_s(POLICY, np.zeros(N))
    np.testing.assert_allclose(lag_s @ (SPEC.control.ki_kpa_per_ms * GAIN_M_PER_KPA), np.eye(N), atol=1e-4)


def test_the_shape_lags_by_the_time_constant_of_the_backbone_and_is_at_rest_with_the_springs():
    """The last section's end moves aside as its last spring gets longer, which no even bend explains."""
    (weights, bias), *_ = POLICY.estimator.layers
    aside = np.zeros_like(weights)
    aside[N - 1, -6] = 0.5  # its x at the end [m] per m of the last spring
    policy = dataclasses.replace(POLICY, estimator=POLICY.estimator._replace(layers=((aside, bias),)))
    lag_s, rate_m_per_s = SPEC.backbone.shape_lag_s, 5e-3 * (np.arange(N) == N - 1)
    start_m = np.full(N, SPEC.geometry.section_length_m)  # straight: x is the motion capture's
    shape = ShapeLag()
    assert not shape.behind(policy, start_m, 0.0).any()
    for k in range(round(8.0 * lag_s / DT_S)):
        spring_m = start_m + k * DT_S * rate_m_per_s
        shape = shape.after(policy, spring_m, 0.0, DT_S)
    behind = shape.behind(policy, spring_m, 0.0)
    np.testing.assert_allclose(behind, [2.5 * lag_s, 0.0, 0.0, 0.0, 0.0, 0.0], rtol=1e-3, atol=2e-3)
    for _ in range(round(12.0 * lag_s / DT_S)):
        shape = shape.after(policy, spring_m, 0.0, DT_S)
    np.testing.assert_allclose(shape.behind(policy, spring_m, 0.0), 0.0, atol=1e-3)


def test_an_error_that_stays_beside_a_round_way_is_made_up_for():
    """The tip is late, wide and high by constants in the axes of the way, less the correction of its goal."""
    way, corrected = WayError(), []
    n_lead, per_tick = round(CONTROLLER.lead_s / DT_S), 2 * np.pi / 20.0 * DT_S

    def axes(k):
        at = k * per_tick
        outward = np.array([np.cos(at), np.sin(at), 0.0])
        return outward, np.array([-np.sin(at), np.cos(at), 0.0]), np.array([0.0, 0.0, 1.0])

    for k in range(1500):
        now, ahead = (np.append(80.0 * axes(tick)[0], np.zeros(3)) for tick in (k, k + n_lead))
        late = corrected[-n_lead] if len(corrected) >= n_lead else np.zeros(6)  # the correction is in force
        outward, along, up = axes(k)
        off_mm = 3.0 * outward - 4.0 * along + 2.0 * up
        way = way.after(ahead, now + np.append(off_mm, np.zeros(3)) + late, CONTROLLER)
        corrected.append(way.correction)
    assert np.linalg.norm(off_mm + late[:3]) < 0.02 * np.linalg.norm(off_mm)
    assert not corrected[n_lead].any() and not way.correction[3:].any()
