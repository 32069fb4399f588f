"""Random pressures of redundant chambers; the circle, the paper's for its arm, smaller for a smaller one."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.control import planes
from mjx_softarm.mechanics.excitation import circle_poses, random_pressures
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import settle_pressures
from tests.arms import FOUR_CHAMBERS, SIX_CHAMBERS

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.mark.parametrize("arm", [FOUR_CHAMBERS, SIX_CHAMBERS], ids=["four", "six"])
def test_redundant_chambers_push_together_as_three_do(arm):
    """Mean and bend of a section's pressures reach as far; all chambers are distinguished."""
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


@pytest.mark.parametrize("name, base_deg", [("sopra", 0.0), ("stiff-flop", 180.0), ("four-chamber", 0.0)])
def test_arms_without_vacuum_reach_their_circles(name, base_deg):
    """A least-squares search finds pressures that hold each pose, all of them with some to spare."""
    spec = ArmSpec.of(Path(name)).replace(mounting={"base_turn_deg": (base_deg, 0.0, 0.0)})
    goals = circle_poses(spec, 4)
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    kpa, params = np.full((4, spec.n_chambers), 0.5 * (low + high)), ArmParams.from_spec(spec)

    def tip(kpa):
        end = settle_pressures(params, kpa)
        place = jnp.concatenate([1e3 * end.tip_position_m, 100.0 * end.tip_rotation[:2, 2]])
        return place, place

    steps = jax.jit(jax.vmap(jax.jacfwd(tip, has_aux=True)))
    wanted = np.concatenate([goals[:, :3], np.zeros((4, 2))], axis=1)
    for _ in range(8):
        slope, place = steps(np.float32(kpa))
        kpa = kpa + np.stack([np.linalg.pinv(s) @ off for s, off in zip(slope, wanted - place, strict=True)])
    assert np.abs(wanted - steps(np.float32(kpa))[1]).max() < 0.1
    assert kpa.min() > low + 5.0 and kpa.max() < high - 5.0
