"""Springs at LDC1612 or LDC1614 converters on I2C buses of a Linux computer; needs smbus2.

Registers and formulas are those of the data sheets, Texas Instruments SNOSCY9 (LDC1612, LDC1614). A converter
runs by itself on an external clock, and goes round its channels. A channel's reading is new if its conversion
ended after the last call; otherwise, or with an error flag, the spring counts as not read. With two addresses
on a bus, nine springs need several buses, or a multiplexer, whose ports Linux shows as buses (device tree
overlay `i2c-mux,pca9548`).
"""

from __future__ import annotations

import fcntl
import importlib
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjx_softarm._support.errors import needing

DATA_MSB, RCOUNT, SETTLECOUNT, CLOCK_DIVIDERS, DRIVE_CURRENT = 0x00, 0x08, 0x10, 0x14, 0x1E  # channel 0
STATUS, ERROR_CONFIG, CONFIG, MUX_CONFIG, RESET_DEV = 0x18, 0x19, 0x1A, 0x1B, 0x1C
IDS = {0x7E: 0x5449, 0x7F: 0x3055}  # manufacturer and device, by register
CLOCK_HZ = 40e6  # external clock
# Divider of both clocks, the coil's and the reference, in a converter with one channel. Its reference may be
# 35 MHz at most, with several channels 40 MHz; a coil's clock has to be below a quarter of the reference
# (SNOSCY9, "Clocking Architecture"). The reading is their ratio, which stays as it is.
DIVIDER_OF_ONE = 2
CONVERSION_S = 0.004  # duration for one channel; by hand: two channels end twice within a tick
SETTLE_S = 2e-5  # wait for a coil before its conversion; by hand: a Q factor of 40 at 2 MHz
BUS_TIMEOUT = 1  # longest transfer, in steps of 10 ms
I2C_TIMEOUT = 0x0702  # ioctl of Linux's i2c-dev


class LdcSprings:
    """Springs' frequencies [Hz], in the order of `channels`.

    Args:
        channels: bus, address (0x2A or 0x2B) and channel of each spring.
        drive_current: setting 0 to 31 of the coils' current; the amplitude at a coil should be 1.2 to 1.8 V.
        timeout_s: time after which no further converter is read in a call.

    Raises:
        InputError: smbus2 is missing.
        ValueError: the channels or the current are none.
        OSError: a bus cannot be opened, or a converter is not there.
    """

    def __init__(
        self, channels: Sequence[Sequence[int]], drive_current: int = 18, timeout_s: float = 0.008
    ) -> None:
        # Springs by converter
        self._springs: dict[tuple[int, int], dict[int, int]] = {}
        for spring, place in enumerate(channels):
            if not isinstance(place, Sequence) or [*map(type, place)] != [int, int, int]:
                raise ValueError(f"channels: got {place}, expected bus, address and channel of each spring")
            bus, address, channel = place
            others = self._springs.setdefault((bus, address), {})
            if channel in others or channel not in range(4):
                raise ValueError(
                    f"channels: got {channels}, expected a channel 0 to 3 of its own for each spring"
                )
            others[channel] = spring
        if not 0 <= drive_current <= 31:
            raise ValueError(f"drive_current: got {drive_current}, expected 0 to 31")
        self._n = len(channels)
        self._timeout_s = timeout_s

        # Buses, and converters set going
        with needing("i2c", "ldc1612"):
            self._smbus: Any = importlib.import_module("smbus2")
        self._buses: dict[int, Any] = {}
        for bus in {bus for bus, _ in self._springs}:
            self._buses[bus] = self._smbus.SMBus(bus)
            fcntl.ioctl(self._buses[bus].fd, I2C_TIMEOUT, BUS_TIMEOUT)
        for (bus, address), springs in self._springs.items():
            self._start(bus, address, sorted(springs), drive_current)

    def read_sensors(self) -> np.ndarray:
        """Return the frequencies (n,) [Hz]; NaN for a spring that was not read."""
        end_s = time.monotonic() + self._timeout_s
        readings = np.full(self._n, np.nan)
        for (bus, address), springs in self._springs.items():
            if time.monotonic() > end_s:
                break
            registers = [STATUS, *(DATA_MSB + 2 * channel + word for channel in springs for word in (0, 1))]
            try:
                status, *words = self._read(bus, address, registers)
            except OSError:  # this converter's springs are not read; all of them end the run
                continue
            for (channel, spring), high, low in zip(springs.items(), words[::2], words[1::2], strict=True):
                unread = status >> (3 - channel) & 1
                errors = high >> 12
                if unread and not errors:
                    readings[spring] = ((high << 16) | low) * CLOCK_HZ / 2**28
        return readings

    def _start(self, bus: int, address: int, channels: Sequence[int], drive_current: int) -> None:
        """Set a converter going round its channels."""
        where = f"LDC1612 at bus {bus}, address {address:#x}"
        try:
            ids = self._read(bus, address, list(IDS))
        except OSError as error:
            raise OSError(f"{where}: got {error.strerror or error}, expected an answer") from error
        if ids != [*IDS.values()]:
            raise OSError(f"{where}: got ids {ids}, expected {[*IDS.values()]}")
        self._write(bus, address, RESET_DEV, 0x8000)  # into sleep mode
        divider = DIVIDER_OF_ONE if len(channels) == 1 else 1
        steps_per_s = CLOCK_HZ / divider / 16
        for channel in channels:
            self._write(bus, address, RCOUNT + channel, round(CONVERSION_S * steps_per_s))
            self._write(bus, address, SETTLECOUNT + channel, round(SETTLE_S * steps_per_s))
            self._write(bus, address, CLOCK_DIVIDERS + channel, divider << 12 | divider)
            self._write(bus, address, DRIVE_CURRENT + channel, drive_current << 11)
        self._write(bus, address, ERROR_CONFIG, 0xF800)  # errors are flagged beside the data
        # One channel all the time, or channels 0 to 1, 2 or 3 in turn; inputs up to 10 MHz
        sequence = 0x8000 | max(channels[-1] - 1, 0) << 13 if len(channels) > 1 else 0
        self._write(bus, address, MUX_CONFIG, sequence | 0x020D)
        # Awake, current as set, external clock
        self._write(bus, address, CONFIG, (channels[0] if len(channels) == 1 else 0) << 14 | 0x1E01)

    def _write(self, bus: int, address: int, register: int, value: int) -> None:
        words = [register, value >> 8, value & 0xFF]
        self._buses[bus].i2c_rdwr(self._smbus.i2c_msg.write(address, words))

    def _read(self, bus: int, address: int, registers: Sequence[int]) -> list[int]:
        """Return the words of registers, read in one transfer."""
        asked = [self._smbus.i2c_msg.write(address, [register]) for register in registers]
        words = [self._smbus.i2c_msg.read(address, 2) for _ in registers]
        self._buses[bus].i2c_rdwr(*(part for pair in zip(asked, words, strict=True) for part in pair))
        return [int.from_bytes(bytes(word), "big") for word in words]
