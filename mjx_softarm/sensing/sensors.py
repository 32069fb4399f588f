"""The inductive springs: resonance frequency <-> calibrated length.

A spring is a coil whose inductance falls as it stretches. It resonates with a capacitor, and with a
compensation inductance in series, at the frequency that the converter reads:

    (2 pi f)^2 C (I + I_comp) = 1        resonance
    I = mu_0 N^2 pi r^2 / l = K / l      a long air coil with wire length l
    L = beta l + delta                   calibration

With y = C (2 pi f)^2, the inverse of the total inductance, both directions are quotients without
overflow in float32 (y is about 1e5 / H, f about 3e6 Hz):

    l = K y / (1 - I_comp y)             y = l / (K + I_comp l)

Source: equations of the sections on sensing and calibration in Meng et al., "Sensor-Space Based Robust
Kinematic Control of Redundant Soft Manipulator by Learning". Their combined mapping prints 4 pi^4 where
the derivation gives 4 pi^3; this module follows the derivation.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace

if TYPE_CHECKING:
    from mjx_softarm.spec import ArmSpec

MU_0_H_PER_M = 1.26e-6  # the paper's value of the vacuum permeability; beta absorbs the last digit


class SensorParams(NamedTuple):
    """Circuit, coil and calibration of the springs; each number is () or (n,)."""

    capacitance_f: Array
    compensation_h: Array  # in series with the coil; may be zero or negative
    coil_hm: Array  # K = mu_0 N^2 pi r^2 [H m]
    beta: Array  # (n,)
    delta_m: Array  # (n,)
    frequency_min_hz: Array  # readings outside of these two are not believed
    frequency_max_hz: Array

    @classmethod
    def from_spec(cls, spec: ArmSpec) -> SensorParams:
        """Parameters in float64; JAX narrows them where they meet its arrays."""
        sensor = spec.sensor
        return cls(
            capacitance_f=sensor.capacitance_f,
            compensation_h=sensor.compensation_h,
            coil_hm=MU_0_H_PER_M * sensor.turns**2 * math.pi * sensor.coil_radius_m**2,
            beta=np.array(spec.per_chamber(sensor.beta)),
            delta_m=np.array(spec.per_chamber(sensor.delta_m)),
            frequency_min_hz=sensor.frequency_min_hz,
            frequency_max_hz=sensor.frequency_max_hz,
        )


class SensorFault(IntEnum):
    """Why a reading gives no length."""

    OK = 0
    NOT_FINITE = 1  # NaN or infinite
    TOO_LOW = 2  # below the believed range: zero, negative, or an open circuit
    TOO_HIGH = 3  # above the believed range
    NO_COIL = 4  # at or above the resonance of the compensation alone: a shorted coil
    NO_LENGTH = 5  # the calibration gives no positive length


class Reading(NamedTuple):
    """Lengths, and which of them are true."""

    length_m: Array  # (..., n), always finite
    fault: Array  # (..., n) int32, a `SensorFault`


def length_from_frequency(frequency_hz: Array, params: SensorParams, fallback_m: Array = 0.0) -> Reading:
    """Calibrated spring lengths of the frequencies that were read.

    A reading that gives no length is reported in `fault`, never passed on: its length is `fallback_m`, and
    no gradient flows through it. A control loop gives the last good lengths, so that one lost reading
    holds its chamber for a tick; how many lost readings in a row stop the arm is for the loop to say. The
    default, 0 m, is a length no spring has; use it where `fault` is looked at.

    Args:
        frequency_hz (..., n) [Hz]: readings, any number at all.
        params: circuit, coil and calibration.
        fallback_m () or (..., n) [m]: length of a faulty reading, finite.
    """
    xp = array_namespace(frequency_hz, fallback_m, *params)
    believed = (frequency_hz >= params.frequency_min_hz) & (frequency_hz <= params.frequency_max_hz)
    safe_hz = xp.where(believed, frequency_hz, params.frequency_min_hz)
    inverse_h = params.capacitance_f * (2.0 * math.pi * safe_hz) ** 2
    coil_share = 1.0 - params.compensation_h * inverse_h  # of the total inductance
    wire_m = params.coil_hm * inverse_h / xp.where(coil_share > 0.0, coil_share, 1.0)
    length_m = params.beta * wire_m + params.delta_m

    fault = xp.zeros(length_m.shape, xp.int32)
    for bad, code in (  # a later one overrules
        (length_m <= 0.0, SensorFault.NO_LENGTH),
        (coil_share <= 0.0, SensorFault.NO_COIL),
        (frequency_hz > params.frequency_max_hz, SensorFault.TOO_HIGH),
        (frequency_hz < params.frequency_min_hz, SensorFault.TOO_LOW),
        (~xp.isfinite(frequency_hz), SensorFault.NOT_FINITE),
    ):
        fault = xp.where(bad, int(code), fault)
    return Reading(xp.where(fault == SensorFault.OK.value, length_m, fallback_m), fault)


def frequency_from_length(length_m: Array, params: SensorParams) -> Array:
    """The frequencies (..., n) [Hz] at which springs of calibrated length (..., n) [m] resonate.

    A length that no coil has reads NaN: a wire length that is not positive, or one that a negative
    compensation leaves without inductance. `length_from_frequency` reports such a reading.
    """
    xp = array_namespace(length_m, *params)
    wire_m = (length_m - params.delta_m) / params.beta
    total_hm = params.coil_hm + params.compensation_h * wire_m  # total inductance times wire length
    resonates = (wire_m > 0.0) & (total_hm > 0.0)
    inverse_h = xp.where(resonates, wire_m, 1.0) / xp.where(resonates, total_hm, 1.0)
    frequency_hz = xp.sqrt(inverse_h / params.capacitance_f) / (2.0 * math.pi)
    return xp.where(resonates, frequency_hz, math.nan)


def frequency_range_hz(spec: ArmSpec) -> np.ndarray:
    """Frequencies (n, 2) [Hz] of the shortest and the longest spring that may be commanded."""
    limits_m = np.array([[spec.springs.length_min_m], [spec.springs.length_max_m]])
    return frequency_from_length(
        np.broadcast_to(limits_m, (2, spec.n_chambers)), SensorParams.from_spec(spec)
    ).T


def describe_faults(frequency_hz: Array, fault: Array, params: SensorParams) -> str:
    """A line for each faulty spring: its number as in the model, what it read and what was expected.

    Args:
        frequency_hz (n,) [Hz]: readings of one arm.
        fault (n,): as `length_from_frequency` reports.
        params: those the readings were converted with.

    Returns:
        The lines, or "" where there is no fault.
    """
    lines = []
    for index, code in enumerate(np.asarray(fault)):
        if code == SensorFault.OK:
            continue
        one = SensorParams(*(float(np.broadcast_to(value, np.shape(fault))[index]) for value in params))
        expected = _expected(SensorFault(code), one)
        lines.append(f"spring{index}: read {float(frequency_hz[index]):.7g} Hz, expected {expected}")
    return "\n".join(lines)


def _expected(fault: SensorFault, params: SensorParams) -> str:
    if fault == SensorFault.NO_COIL:
        limit_hz = 0.5 / math.pi / math.sqrt(params.capacitance_f * params.compensation_h)
        return f"below {limit_hz:.7g} Hz, where the compensation resonates without the coil"
    if fault == SensorFault.NO_LENGTH:
        return f"a length > 0 m after beta = {params.beta:g} and delta = {params.delta_m:g} m"
    return f"{params.frequency_min_hz:g} to {params.frequency_max_hz:g} Hz"
