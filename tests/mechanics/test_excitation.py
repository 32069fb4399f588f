"""Random pressures of redundant chambers; the circle, the paper's for its arm, smaller for a smaller one."""

import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.control import planes
from mjx_softarm.mechanics.excitation import circle_poses, random_pressures
from tests.arms import FOUR_CHAMBERS, SIX_CHAMBERS


@pytest.mark.parametrize("arm", [FOUR_CHAMBERS, SIX_CHAMBERS], ids=["four", "six"])
def test_redundant_chambers_push_together_as_three_do(arm):
    """Mean and bend of a section's pressures reach as far; all chambers are told apart."""
    pressure_kpa = random_pressures(arm, 4000, 0)
    assert pressure_kpa.min() >= -40.0 and pressure_kpa.max() <= 20.0

    def spread(arm, kpa):
        n = arm.structure.chambers_per_section
        return np.quantile(kpa.reshape(-1, n) @ np.linalg.pinv(planes(n)).T, [0.01, 0.99], axis=0)

    three = ArmSpec.default()
    together, of_three = spread(arm, pressure_kpa), spread(three, random_pressures(three, 4000, 0))
    np.testing.assert_allclose(together, of_three, rtol=0.2)
    alone = 30.0 * np.cos(np.random.default_rng(0).uniform(0.0, np.pi, pressure_kpa.shape))
    assert (np.ptp(spread(arm, alone), axis=0) < np.ptp(together, axis=0)).all()
    assert np.linalg.matrix_rank(pressure_kpa[:100], tol=10.0) == arm.n_chambers


def test_the_circle_is_as_large_as_the_arm_is_long():
    spec = ArmSpec.default()
    around = circle_poses(spec, 8)
    np.testing.assert_allclose(np.hypot(around[:, 0], around[:, 1]), 80.0, rtol=1e-6)
    np.testing.assert_array_equal(around[:, 2:], [[-575.0, 0.0, 0.0, 0.0]] * 8)
    half = spec.replace(geometry={"section_length_m": 0.5 * spec.geometry.section_length_m})
    np.testing.assert_allclose(circle_poses(half, 8), 0.5 * around, rtol=1e-6)
