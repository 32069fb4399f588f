"""Sensors against the paper's equations in float64, and every reading that is no length."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_softarm.env  # noqa: F401  # registers the sensors as pytrees
from mjx_softarm import ArmSpec
from mjx_softarm.sensing.sensors import Sensor

pytestmark = pytest.mark.usefixtures("strict")

LENGTHS_M = np.linspace(0.060, 0.320, 9 * 29).reshape(29, 9)
COMPENSATIONS_H = (1.0e-6, 0.0, -1.0e-6, 4.0e-6)
# The converter's own range, so that each kind of fault can be reached.
WIDE = ArmSpec.default().replace(sensor={"frequency_min_hz": 1.0e5, "frequency_max_hz": 1.0e7})


def make_spec(compensation_h=1.0e-6):
    beta = tuple(np.linspace(0.90, 0.98, 9))
    delta_m = tuple(np.linspace(-0.002, 0.003, 9))
    return WIDE.replace(sensor={"compensation_h": compensation_h, "beta": beta, "delta_m": delta_m})


def frequency_by_the_book(length_m, spec):
    """Resonance of capacitor, coil and compensation, equation by equation."""
    sensor = spec.sensor
    wire_m = (length_m - np.array(sensor.delta_m)) / np.array(sensor.beta)
    coil_h = 1.26e-6 * sensor.turns**2 * math.pi * sensor.coil_radius_m**2 / wire_m
    return 1.0 / (2.0 * math.pi * np.sqrt(sensor.capacitance_f * (coil_h + sensor.compensation_h)))


def relative_error(got, expected):
    return np.max(np.abs(np.asarray(got, np.float64) / expected - 1.0))


@pytest.mark.parametrize("compensation_h", COMPENSATIONS_H)
@pytest.mark.parametrize(
    "dtype, batched, to_hz, to_m, both",
    [
        (np.float64, lambda f: f, 1e-14, 1e-13, 1e-13),
        (np.float32, lambda f: f, 2e-6, 2e-6, 1e-6),
        (np.float32, lambda f: jax.jit(jax.vmap(f)), 2e-6, 2e-6, 1e-6),
    ],
    ids=["numpy64", "numpy32", "jax32"],
)
def test_the_equations_hold_both_ways(compensation_h, dtype, batched, to_hz, to_m, both):
    spec = make_spec(compensation_h)
    sensor = jax.tree.map(dtype, spec.spring_sensor)
    lengths, book = LENGTHS_M.astype(dtype), frequency_by_the_book(LENGTHS_M, spec)
    frequency, lengths_of = batched(sensor.readings)(lengths), batched(sensor.lengths)
    reading, again = lengths_of(book.astype(dtype)), lengths_of(frequency)
    assert frequency.dtype == reading.length_m.dtype == dtype and not np.any(reading.lost)
    assert relative_error(frequency, book) < to_hz
    assert relative_error(reading.length_m, LENGTHS_M) < to_m
    assert relative_error(again.length_m, lengths.astype(np.float64)) < both


@pytest.mark.parametrize("convert", [Sensor.lengths, jax.jit(Sensor.lengths)], ids=["numpy", "jax"])
@pytest.mark.filterwarnings("error")
def test_bad_readings_are_reported_and_hold_their_fallback(convert):
    bad = np.float32([math.nan, math.inf, -math.inf, 0.0, -4.0e6, 0.999e5, 1.001e7, 3.0e38, 9.0e6])
    last_good = np.linspace(0.10, 0.18, 9, dtype=np.float32)
    sensor = make_spec().spring_sensor
    reading = convert(sensor, bad, last_good)
    assert reading.lost.all()
    np.testing.assert_array_equal(reading.length_m, last_good)
    one_bad = convert(sensor, np.float32([math.nan] + 8 * [1.0e6]), last_good)
    assert one_bad.lost.tolist() == [True] + 8 * [False]
    *beyond, no_coil = sensor.describe_lost(bad, reading.lost)
    assert all(text.endswith("Hz, expected 100000 to 1e+07 Hz") for text in beyond)
    assert "got 9000000 Hz, expected below 8761191 Hz, where the compensation resonates" in no_coil


def test_a_calibration_without_positive_length_is_reported():
    params = WIDE.replace(sensor={"delta_m": -0.05}).spring_sensor
    reading = params.lengths(np.full(9, 1.0e6))
    assert reading.lost.all() and not reading.length_m.any()
    for text in params.describe_lost(np.full(9, 1.0e6), reading.lost):
        assert text.endswith("expected a length > 0 m after beta = 0.93 and delta = -0.05 m")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("compensation_h, length_m", [(1e-6, 0.0), (1e-6, -0.9), (-1e-5, 0.2)])
def test_a_length_no_coil_has_reads_nan_and_is_reported(compensation_h, length_m):
    params = dataclasses.replace(WIDE.spring_sensor, compensation_h=compensation_h, delta_m=np.zeros(9))
    frequency = params.readings(np.full(9, length_m))
    assert np.isnan(frequency).all()
    assert params.lengths(frequency).lost.all()


@pytest.mark.filterwarnings("error")
def test_a_reading_exactly_at_the_compensation_s_resonance_divides_by_nothing():
    frequency = np.linspace(2.0e6, 8.0e6, 200)
    inverse_h = 3.3e-10 * (2.0 * math.pi * frequency) ** 2
    exactly = 1.0 - (1.0 / inverse_h) * inverse_h == 0.0
    assert exactly.any()
    changes = {"compensation_h": 1.0 / inverse_h, "beta": np.ones(200), "delta_m": np.zeros(200)}
    reading = dataclasses.replace(WIDE.sensor, **changes).lengths(frequency)
    assert reading.lost[exactly].all()


def test_a_bad_reading_leaks_no_gradient():
    params = make_spec().spring_sensor
    values = np.float32([4.0e6, math.nan, math.inf, -math.inf, 0.0, -4.0e6, 9.9e4, 2.0e7, 9.0e6])

    def total(frequency, delta_m, fallback_m):
        reading = dataclasses.replace(params, delta_m=delta_m).lengths(frequency, fallback_m)
        return jnp.sum(reading.length_m)

    delta_m, fallback_m = jnp.zeros(9), jnp.full(9, 0.2)
    slopes = jax.jit(jax.grad(total, argnums=(0, 1, 2)))
    by_frequency, by_delta, by_fallback = slopes(jnp.asarray(values), delta_m, fallback_m)
    good = np.arange(9) == 0
    np.testing.assert_array_equal(by_delta, good.astype(float))
    np.testing.assert_array_equal(by_fallback, (~good).astype(float))
    np.testing.assert_array_equal(by_frequency[1:], 0.0)
    step_hz = 10.0
    below, above = (params.lengths(np.full(9, 4.0e6 + h)) for h in (-step_hz, step_hz))
    slope = (above.length_m[0] - below.length_m[0]) / (2 * step_hz)
    assert by_frequency[0] == pytest.approx(slope, rel=1e-4)


def test_gradient_of_an_impossible_length_is_finite():
    params = make_spec().spring_sensor
    lengths = jnp.array([0.2, -0.1, -0.2, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
    slope = jax.grad(lambda x: jnp.nansum(params.readings(x)))(lengths)
    assert np.isfinite(slope).all()
    assert slope[0] > 0 and slope[1] == slope[2] == 0
