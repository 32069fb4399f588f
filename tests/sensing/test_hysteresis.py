"""Stop operators: elastic at first, then sliding, without drift by noise."""

import numpy as np

from mjx_softarm.sensing.hysteresis import stop_after, stops

STROKE_M = np.array([0.01, 0.02])


def test_a_state_is_elastic_within_its_stroke_and_slides_beyond():
    found = stops(np.array([[0.2, 0.2], [0.205, 0.205], [0.23, 0.21], [0.225, 0.205], [0.2, 0.1]]), STROKE_M)
    np.testing.assert_allclose(found, [[0, 0], [0.5, 0.25], [1, 0.5], [0.5, 0.25], [-1, -1]], atol=1e-12)


def test_a_lost_length_leaves_the_state():
    found = stop_after(np.array([0.3, -0.2]), np.array([np.nan, 0.002]), STROKE_M)
    np.testing.assert_allclose(found, [0.3, -0.1])


def test_noise_at_rest_moves_a_state_by_no_more_than_its_range():
    noise_m = 1e-4 * np.random.default_rng(0).standard_normal((2_000, 2))
    state = start = np.array([1.0, -1.0])
    for moved_m in np.diff(noise_m, axis=0):
        state = stop_after(state, moved_m, STROKE_M)
    assert np.all(np.abs(state - start) * STROKE_M < np.ptp(noise_m, axis=0))
