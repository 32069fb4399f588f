"""The circle: the paper's for its arm, as much smaller for a smaller one."""

import numpy as np

from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.excitation import circle_poses


def test_the_circle_is_as_large_as_the_arm_is_long():
    spec = ArmSpec.default()
    around = circle_poses(spec, 8)
    np.testing.assert_allclose(np.hypot(around[:, 0], around[:, 1]), 80.0, rtol=1e-6)
    np.testing.assert_array_equal(around[:, 2:], [[-575.0, 0.0, 0.0, 0.0]] * 8)
    half = spec.replace(geometry={"section_length_m": 0.5 * spec.geometry.section_length_m})
    np.testing.assert_allclose(circle_poses(half, 8), 0.5 * around, rtol=1e-6)
