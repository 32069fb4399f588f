"""The sensor-space law on plants whose rest is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.control import (
    YIELD_M_PER_KPA,
    Gains,
    LawState,
    allocated_error,
    blocked_springs,
    pressures,
    saturated,
)

pytestmark = pytest.mark.usefixtures("strict")

DT_S = 0.02
GAINS = Gains.from_spec(ArmSpec.default())
LOW, HIGH = GAINS.pressure_min_kpa, GAINS.pressure_max_kpa
FREE_M = 0.200
M_PER_KPA = 2.0e-3
LAG_S = 0.1


def plant(length_m, pressure_kpa, compliance):
    """Lengths a tick later of springs that follow their pressures with a first-order lag."""
    rest_m = FREE_M + compliance @ pressure_kpa
    return rest_m + (length_m - rest_m) * np.exp(-DT_S / LAG_S)


def rest(reference_m, gains, compliance):
    """Lengths and pressures at rest, from the free length; 160 s are enough."""
    length = np.full(len(compliance), FREE_M)
    state = LawState.at_rest(np.zeros(compliance.shape[1]), length)
    for _ in range(8000):
        pressure, state = pressures(reference_m, length, state, gains, DT_S)
        length = plant(length, pressure, compliance)
    np.testing.assert_allclose(pressure, state.integral_kpa, atol=1e-6)
    return length, pressure


def test_one_tick_by_hand():
    """Springs off their references; then a reference on its way and a spring that moves."""
    gains = Gains(100.0, 500.0, 0.0, 0.0, -40.0, 20.0)
    reference, length = np.array([0.21, 0.20, 0.60, 0.10]), np.array([0.20, 0.21, 0.20, 0.20])
    start = LawState.at_rest(np.array([1.0, 1.0, 19.0, -39.5]), length)
    pressure, state = pressures(reference, length, start, gains, 0.02)
    # integral + 10 e, then + 100 e, each within the limits
    np.testing.assert_allclose(state.integral_kpa, [1.1, 0.9, 20.0, -40.0])
    np.testing.assert_allclose(pressure, [2.1, -0.1, 20.0, -40.0])

    gains = Gains(100.0, 500.0, 10.0, 0.08, -40.0, 20.0)
    start = LawState(np.zeros(1), np.array([0.20]), np.array([0.198]))
    pressure, state = pressures(np.array([0.21]), np.array([0.20]), start, gains, 0.02)
    # A fifth of the way to the reference; half of the way to the length read
    np.testing.assert_allclose(state.reference_m, 0.202)
    np.testing.assert_allclose(state.length_m, 0.199)
    np.testing.assert_allclose(state.integral_kpa, 0.02)
    np.testing.assert_allclose(pressure, 0.02 + 0.2 - 10.0 * 0.001 / 0.02)


def redundant_arm(n_chambers, n_springs):
    """Gains of an arm with so many chambers and springs a section, and its compliance [m/kPa]."""
    counts = {"chambers_per_section": n_chambers, "springs_per_section": n_springs}
    gains = Gains.from_spec(ArmSpec.default().replace(structure=counts))
    angle = 2 * np.pi * np.arange(n_chambers) / n_chambers
    plane = np.stack([np.ones(n_chambers), np.cos(angle), np.sin(angle)], axis=-1)
    stretch = M_PER_KPA / n_chambers * np.diag([1.8, 3.3, 2.7])
    section = plane[:: n_chambers // n_springs] @ stretch @ plane.T
    return gains, np.kron(np.eye(3), section)


def test_matrices_of_four_chambers_by_hand():
    """Opposite pairs that disagree are the redundant pressure; its complement is each chamber's error."""
    gains, _ = redundant_arm(4, 4)
    redundant = 0.25 * np.array([[1, -1, 1, -1], [-1, 1, -1, 1]] * 2)
    np.testing.assert_allclose(gains.allocation.redundant, np.kron(np.eye(3), redundant), atol=1e-12)
    complement = np.eye(12) - gains.allocation.redundant
    np.testing.assert_allclose(gains.allocation.chamber_error, complement, atol=1e-12)
    assert GAINS.allocation is None


@pytest.mark.parametrize("counts", [(4, 4), (6, 3), (6, 6)])
def test_redundant_chambers_follow_references_with_the_least_pressures(counts):
    gains, compliance = redundant_arm(*counts)
    wanted_kpa = np.random.default_rng(7).uniform(-8.0, 5.0, compliance.shape[1])
    reference = FREE_M + compliance @ wanted_kpa
    length, pressure = rest(reference, gains, compliance)
    np.testing.assert_allclose(length, reference, atol=1e-8)
    least = np.linalg.lstsq(compliance, reference - FREE_M, rcond=None)[0]
    np.testing.assert_allclose(gains.allocation.redundant @ pressure, 0.0, atol=1e-5)
    np.testing.assert_allclose(pressure, least, atol=1e-3)


def coupled_arm():
    """Gains of the paper's arm, and a compliance [m/kPa] that couples all of its chambers."""
    mix = np.random.default_rng(3).normal(size=(9, 9))
    return GAINS, M_PER_KPA * (np.eye(9) + 0.03 * (mix @ mix.T))


@pytest.mark.parametrize(
    "arm", [coupled_arm(), redundant_arm(4, 4), redundant_arm(6, 3)], ids=["coupled", "four", "six"]
)
@pytest.mark.parametrize("slow", [False, True])
def test_rest_is_complementary_whatever_the_gains(arm, slow):
    """Chambers within their limits close their errors; others have them outward, and count as saturated."""
    gains, compliance = arm
    if slow:
        gains = gains._replace(kp_kpa_per_m=0.0, ki_kpa_per_ms=100.0, kd_kpa_s_per_m=0.0)
    reference = FREE_M + np.random.default_rng(3).uniform(-0.25, 0.15, len(compliance))
    length, pressure = rest(reference, gains, compliance)
    error = allocated_error(reference - length, pressure, gains.allocation)
    at_high, at_low = pressure >= HIGH, pressure <= LOW
    assert at_high.any() and at_low.any() and (~at_high & ~at_low).any()
    assert (error[at_high] >= 0).all() and (error[at_low] <= 0).all()
    np.testing.assert_allclose(error[~at_high & ~at_low], 0.0, atol=1e-8)
    flags = saturated(pressure, reference, length, gains, tolerance_m=1e-4)
    np.testing.assert_array_equal(flags, np.abs(error) > 1e-4)


def test_a_limit_is_made_up_for_with_redundant_pressure():
    """Springs are off by fractions of a millimetre for each kPa of redundant pressure."""
    gains, compliance = redundant_arm(4, 4)
    reference = FREE_M + compliance @ np.tile([25.0, 0.0, 0.0, 0.0], 3)  # most of it by the first chamber
    length, pressure = rest(reference, gains._replace(pressure_max_kpa=17.0), compliance)
    assert (pressure[::4] == 17.0).all()
    redundant_kpa = gains.allocation.redundant @ pressure
    assert np.abs(reference - length).max() < 4 * YIELD_M_PER_KPA * np.abs(redundant_kpa).max()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_long_saturation_is_left_at_once(sign):
    gains, limit = GAINS._replace(reference_s=0.0), HIGH if sign > 0 else LOW
    length = np.full(9, FREE_M + M_PER_KPA * limit)  # as far as the limit takes it
    state = LawState.at_rest(np.zeros(9), length)
    for _ in range(round(30.0 / DT_S)):
        pressure, state = pressures(np.full(9, FREE_M + sign * 0.2), length, state, gains, DT_S)
    np.testing.assert_array_equal(pressure, limit)
    pressure, _ = pressures(length - sign * 0.005, length, state, gains, DT_S)
    assert (pressure != limit).all()


def test_saturated_needs_the_limit_and_the_error_it_blocks():
    #                   tracks  high    on it   inward  low     on it   inward  within  high
    pressure = np.array([0.0, HIGH, HIGH, HIGH, LOW, LOW, LOW, 19.9, HIGH])
    error = 1e-3 * np.array([9.0, 9.0, 0.4, -9.0, -9.0, -0.4, 9.0, 9.0, 0.6])
    got = saturated(pressure, FREE_M + error, np.full(9, FREE_M), GAINS, 0.5e-3)
    np.testing.assert_array_equal(got, [0, 1, 0, 0, 1, 0, 0, 0, 1])


@pytest.mark.parametrize("to_library", [np.asarray, jnp.asarray])
def test_limits_that_float32_rounds_are_still_limits(to_library):
    gains = GAINS._replace(pressure_min_kpa=-40.1, pressure_max_kpa=20.1)
    reference, length, integral = map(to_library, np.float32([[0.4, 0.0], [0.2, 0.2], [20.0, -40.0]]))
    pressure, _ = pressures(reference, length, LawState.at_rest(integral, length), gains, DT_S)
    assert pressure.dtype == np.float32
    assert saturated(pressure, reference, length, gains, 1e-3).all()


@pytest.mark.parametrize("gains", [GAINS, redundant_arm(4, 4)[0], redundant_arm(6, 3)[0]], ids=[3, 4, 6])
def test_jax_vmapped_and_scanned_gives_numpy_s_pressures(gains):
    n_chambers, n_springs = (9, 9) if gains.allocation is None else gains.allocation.chamber_error.shape
    rng = np.random.default_rng(5)
    reference = np.float32(rng.uniform(0.10, 0.26, (50, 6, n_springs)))  # ticks, arms, springs
    length = np.float32(rng.uniform(0.10, 0.26, (50, 6, n_springs)))

    def tick(state, now):
        pressure, state = jax.vmap(lambda r, x, s: pressures(r, x, s, gains, DT_S))(*now, state)
        flags = jax.vmap(lambda p, r, x: saturated(p, r, x, gains, 1e-3))(pressure, *now)
        return state, (pressure, flags)

    start = LawState.at_rest(jnp.zeros((6, n_chambers)), jnp.asarray(length[0]))
    _, (got, flags) = jax.jit(lambda *now: jax.lax.scan(tick, start, now))(reference, length)
    state = LawState.at_rest(np.zeros((6, n_chambers), np.float32), length[0])
    for k in range(50):
        expected, state = pressures(reference[k], length[k], state, gains, DT_S)
        np.testing.assert_allclose(got[k], expected, rtol=1e-6, atol=1e-6 * HIGH)
        flagged = saturated(expected, reference[k], length[k], gains, 1e-3)
        np.testing.assert_array_equal(flags[k], flagged)
    assert got.dtype == expected.dtype == np.float32


def test_a_saturated_chamber_blocks_the_springs_whose_errors_it_has():
    """Its own; all four of a section; of three springs, its own or all, as one of six chambers stands."""
    flags = np.zeros(9, bool)
    flags[4] = True
    np.testing.assert_array_equal(blocked_springs(flags, GAINS), flags)
    four, six = (redundant_arm(*counts)[0] for counts in ((4, 4), (6, 3)))
    flags = np.zeros((2, 12), bool)
    flags[0, 5] = True
    expected = np.zeros((2, 12), bool)
    expected[0, 4:8] = True
    np.testing.assert_array_equal(blocked_springs(flags, four), expected)
    beside, opposite = np.eye(18, dtype=bool)[[6, 7]]  # of the second section
    np.testing.assert_array_equal(np.flatnonzero(blocked_springs(beside, six)), [3])
    np.testing.assert_array_equal(np.flatnonzero(blocked_springs(jnp.asarray(opposite), six)), [3, 4, 5])
