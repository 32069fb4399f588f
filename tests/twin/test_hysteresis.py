"""Stop operators against closed forms: area of a loop, return-point memory, passivity."""

import numpy as np
import pytest

from mjx_softarm.twin.arm import StopOperators


def test_hysteresis_loop_has_the_area_of_the_closed_form():
    """A stop of stiffness k and limit k r, moved by +-a, loses 4 k r (a - r) a turn, or nothing."""
    stiffness, stroke, a = np.array([100.0, 40.0, 7.0]), np.array([0.002, 0.01, 0.05]), 0.02
    stops = StopOperators(stiffness[None], (stiffness * stroke)[None], np.zeros(1))
    x = a * np.sin(2 * np.pi * np.linspace(0.0, 2.0, 80_001))
    force = np.array([stops.move(x[k : k + 1])[0] for k in range(len(x))])
    turn = slice(40_000, None)  # the second
    area = np.sum(0.5 * (force[turn][1:] + force[turn][:-1]) * np.diff(x[turn]))
    slides = stroke < a
    assert area == pytest.approx(np.sum((4 * stiffness * stroke * (a - stroke))[slides]), rel=1e-4)


def test_hysteresis_remembers_where_it_turned():
    """Return-point memory: a small loop on the way closes, and leaves no trace."""
    stops = [StopOperators(np.full((1, 3), 50.0), np.array([[0.1, 0.3, 0.7]]), np.zeros(1)) for _ in range(2)]
    straight = [0.03, -0.02, 0.01]
    detour = [0.03, -0.02, 0.0, -0.01, 0.0, 0.01]
    for x in straight:
        direct = stops[0].move(np.array([x]))
    for x in detour:
        around = stops[1].move(np.array([x]))
    np.testing.assert_allclose(around, direct, atol=1e-12)


def test_hysteresis_never_gives_more_than_it_took():
    rng = np.random.default_rng(0)
    limit = rng.uniform(0.1, 1.0, (5, 3))
    stops = StopOperators(rng.uniform(10.0, 100.0, (5, 3)), limit, np.zeros(5))
    step = 0.01 * rng.standard_normal((5000, 5))
    force = np.array([stops.move(x) for x in np.cumsum(step, axis=0)])
    assert (np.cumsum(force * step, axis=0) >= 0.0).all()
    assert (np.abs(force) <= limit.sum(axis=1) + 1e-12).all()
