"""Sensors of the springs: readings <-> calibrated lengths, and readings that are lost.

A sensor is one class, whose fields are the section `[sensor]` of a specification, chosen by `kind`. Its
methods `raw_length` and `raw_reading` map between readings and raw lengths l. All sensors share the
calibration L = beta l + delta. To add a sensor, write a subclass of `Sensor` and list it in `SENSORS`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import numpy as np

from mjx_softarm._support.fields import PerChamber, anything, not_negative, positive, rule_of
from mjx_softarm._support.xp import Array, array_namespace

MU_0_H_PER_M = 1.26e-6  # the paper's value of the vacuum permeability; beta absorbs the last digit


class Reading(NamedTuple):
    """Lengths by the sensors, and which readings gave none."""

    length_m: Array  # (..., n), always finite
    lost: Array  # (..., n) bool


@dataclass(frozen=True)
class Sensor:
    """One kind of length sensor, calibrated for each of n springs.

    In a specification, beta and delta are one number or one per spring; `per_spring` spreads them to arrays
    (n,). NumPy and JAX take it alike; `mjx_softarm.env` registers it as a pytree whose leaves are the fields.
    """

    kind: ClassVar[str]  # `kind` in the specification
    reading_name: ClassVar[str]  # name of the readings in logs and actions
    units: ClassVar[Mapping[str, float]]  # units of logs, as multiples of the first, which is used here
    range_fields: ClassVar[tuple[str, str]]  # fields with the least and the greatest believed reading
    plausible: ClassVar[tuple[float, float]]  # range of medians; a log's column outside has another unit
    spike: ClassVar[float]  # least distance of an outlier from the readings before and after it
    noise: ClassVar[float]  # standard deviation of a twin's readings
    resolution: ClassVar[float]  # step of a twin's converter

    beta: PerChamber | Array = positive(per="springs")
    delta_m: PerChamber | Array = anything(per="springs")

    def per_spring(self, n: int) -> Sensor:
        """Return the sensor with an array (n,), float64, for each field that has a number per spring."""
        names = [item.name for item in dataclasses.fields(self) if rule_of(item).per]
        arrays = {name: np.full(n, getattr(self, name), float) for name in names}
        return dataclasses.replace(self, **arrays)

    @property
    def unit(self) -> str:
        """Unit of the readings."""
        return next(iter(self.units))

    @property
    def range(self) -> tuple[Array, Array]:
        """Least and greatest reading that is believed."""
        low, high = self.range_fields
        return getattr(self, low), getattr(self, high)

    def raw_length(self, readings: Array) -> tuple[Array, Array]:
        """Map believed readings (..., n) to finite raw lengths [m], and to whether they exist (bool)."""
        raise NotImplementedError

    def raw_reading(self, raw_m: Array) -> tuple[Array, Array]:
        """Map raw lengths (..., n) [m] to finite readings, and to whether they exist (bool)."""
        raise NotImplementedError

    def lengths(self, readings: Array, fallback_m: Array = 0.0) -> Reading:
        """Return the calibrated spring lengths of readings (..., n) [unit], which may be any numbers.

        A reading is lost that is not believed, or that gives no length > 0. Its length is `fallback_m`, () or
        (..., n) [m], and no gradient flows through it. A control loop passes the last good lengths, so that
        one lost reading holds the arm for a tick.
        """
        # Readings that are not believed are replaced, so that no NaN arises on their way.
        xp = array_namespace(readings, fallback_m, *vars(self).values())
        low, high = self.range
        believed = (readings >= low) & (readings <= high)
        raw_m, exists = self.raw_length(xp.where(believed, readings, low))
        length_m = self.beta * raw_m + self.delta_m
        lost = ~(believed & exists & (length_m > 0.0))
        return Reading(xp.where(lost, fallback_m, length_m), lost)

    def readings(self, length_m: Array) -> Array:
        """Return the readings (..., n) [unit] of calibrated lengths (..., n) [m]; NaN where there is none."""
        xp = array_namespace(length_m, *vars(self).values())
        readings, exists = self.raw_reading((length_m - self.delta_m) / self.beta)
        return xp.where(exists, readings, math.nan)

    def describe_lost(self, readings: np.ndarray, lost: np.ndarray) -> list[str]:
        """Return a sentence for each lost reading of one arm, both (n,) as of `lengths`."""
        sentences = []
        for index in np.flatnonzero(lost):
            each = {name: np.broadcast_to(value, np.shape(lost)) for name, value in vars(self).items()}
            one = type(self)(**{name: float(value[index]) for name, value in each.items()})
            reading = float(readings[index])
            expected = one.expected(reading)
            sentences.append(f"spring{index}: got {reading:.7g} {self.unit}, expected {expected}")
        return sentences

    def expected(self, reading: float) -> str:
        """Return what is expected in place of a lost reading, in words, for the sensor of one spring."""
        low, high = self.range
        if low <= reading <= high:
            return f"a length > 0 m after beta = {self.beta:g} and delta = {self.delta_m:g} m"
        return f"{low:g} to {high:g} {self.unit}"


@dataclass(frozen=True)
class Coil(Sensor):
    """The paper's sensor: the spring is a coil, and its resonance frequency is read.

    The coil's inductance falls as it stretches. It resonates with a capacitor, and with a compensation
    inductance in series, at the frequency f that the converter reads:

        (2 pi f)^2 C (I + I_comp) = 1        resonance
        I = mu_0 N^2 pi r^2 / l = K / l      a long air coil with wire length l

    With y = C (2 pi f)^2, the inverse of the total inductance, both directions are quotients without
    overflow in float32 (y is about 1e5 / H, f about 3e6 Hz):

        l = K y / (1 - I_comp y)             y = l / (K + I_comp l)

    Source: sections on sensing and calibration in Meng et al., "Sensor-Space Based Robust Kinematic Control
    of Redundant Soft Manipulator by Learning", whose combined mapping prints 4 pi^4 instead of 4 pi^3.
    """

    kind = "coil"
    reading_name = "frequency"
    units = MappingProxyType({"Hz": 1.0, "kHz": 1e3, "MHz": 1e6})
    range_fields = ("frequency_min_hz", "frequency_max_hz")
    plausible = (1e4, 1e7)  # the LDC1612 reads from 1 kHz, but no such coil resonates below 10 kHz
    spike = 1e3
    noise = 300.0  # assumed: 0.04 mm of a spring 0.2 m long; far above the converter's own
    resolution = 40e6 / 2**28  # LDC1612 data sheet, TI SNOSCY9: 28 bits of a reference clock of 40 MHz

    capacitance_f: float | Array = positive()
    compensation_h: float | Array = anything()  # inductance in series with the coil; may be zero or negative
    turns: float | Array = positive()
    coil_radius_m: float | Array = positive()
    frequency_min_hz: float | Array = positive()
    frequency_max_hz: float | Array = positive()

    @property
    def coil_hm(self) -> Array:
        """K = mu_0 N^2 pi r^2 [H m]."""
        return MU_0_H_PER_M * self.turns**2 * math.pi * self.coil_radius_m**2

    def raw_length(self, readings: Array) -> tuple[Array, Array]:
        """Map frequencies to wire lengths; there is none where the compensation resonates without a coil."""
        xp = array_namespace(readings, *vars(self).values())
        inverse_h = self.capacitance_f * (2.0 * math.pi * readings) ** 2  # y
        coil_share = 1.0 - self.compensation_h * inverse_h  # coil's share of the total inductance
        exists = coil_share > 0.0
        return self.coil_hm * inverse_h / xp.where(exists, coil_share, 1.0), exists

    def raw_reading(self, raw_m: Array) -> tuple[Array, Array]:
        """Map wire lengths to frequencies; there is none where the total inductance is not positive."""
        xp = array_namespace(raw_m, *vars(self).values())
        total_hm = self.coil_hm + self.compensation_h * raw_m  # total inductance times wire length
        exists = (raw_m > 0.0) & (total_hm > 0.0)
        inverse_h = xp.where(exists, raw_m, 1.0) / xp.where(exists, total_hm, 1.0)
        return xp.sqrt(inverse_h / self.capacitance_f) / (2.0 * math.pi), exists

    def expected(self, reading: float) -> str:
        low, high = self.range
        if not low <= reading <= high or self.raw_length(reading)[1]:
            return super().expected(reading)
        limit_hz = 0.5 / math.pi / math.sqrt(self.capacitance_f * self.compensation_h)
        return f"below {limit_hz:.7g} Hz, where the compensation resonates without the coil"


@dataclass(frozen=True)
class DrawWire(Sensor):
    """A draw-wire encoder, whose voltage is proportional to the length of wire that is drawn out."""

    kind = "draw_wire"
    reading_name = "voltage"
    units = MappingProxyType({"V": 1.0, "mV": 1e-3})
    range_fields = ("voltage_min_v", "voltage_max_v")
    plausible = (0.02, 24.0)
    spike = 5e-3
    noise = 2e-4  # assumed: 0.04 mm of an encoder of 5 V at 1 m
    resolution = 5.0 / 2**16  # assumed: a converter of 16 bits at 5 V

    m_per_v: float | Array = positive()
    voltage_min_v: float | Array = not_negative()
    voltage_max_v: float | Array = positive()

    def raw_length(self, readings: Array) -> tuple[Array, Array]:
        """Map voltages to lengths of drawn wire."""
        raw_m = self.m_per_v * readings
        return raw_m, raw_m >= 0.0

    def raw_reading(self, raw_m: Array) -> tuple[Array, Array]:
        """Map lengths of drawn wire to voltages; there is none below zero."""
        return raw_m / self.m_per_v, raw_m >= 0.0


SENSORS: Mapping[str, type[Sensor]] = MappingProxyType({sensor.kind: sensor for sensor in (Coil, DrawWire)})
