"""Springs at converters on I2C: a stand-in of the chips, register by register, after TI's SNOSCY9."""

import errno
import time

import numpy as np
import pytest

from mjx_softarm.deploy.drivers import ldc1612
from mjx_softarm.deploy.drivers.ldc1612 import LdcSprings

CLOCK_HZ = 40e6
BUSY_S = 5.0  # this machine may be busy
AT = [(1, 0x2A, 0), (1, 0x2A, 1), (1, 0x2B, 1), (3, 0x2A, 0), (3, 0x2A, 1), (3, 0x2A, 2), (3, 0x2A, 3)]
HZ = 1e6 * np.array([2.1, 3.3, 9.9, 2.5, 3.5, 4.5, 2.9])


class Chip:
    """A converter: 16-bit registers, conversions that go on while it is awake."""

    def __init__(self, hz):
        self.hz, self.pointer, self.fault, self.gone = dict(hz), 0, 0, False
        self.reset()

    def reset(self):
        self.registers = {0x7E: 0x5449, 0x7F: 0x3055, 0x1A: 0x2801, 0x1B: 0x020F, 0x18: 0, 0x19: 0}
        self.data = {}

    def channels(self):
        """Channels that are converted: one, or the first two to four in turn."""
        if not self.registers[0x1B] >> 15:
            return [self.registers[0x1A] >> 14]
        return range((2, 3, 4, 2)[self.registers[0x1B] >> 13 & 3])

    def convert(self, only=(0, 1, 2, 3)):
        """End a conversion of channels."""
        if self.registers[0x1A] & 0x2000:  # asleep
            return
        assert (
            self.registers[0x1A] & 0x0200 and self.registers[0x1A] & 0x1000
        )  # external clock, current as set
        for channel in {*self.channels()} & {*only} & {*self.hz}:
            # Clocks and their limits: table of the data sheet's "Clocking Architecture", external clock
            dividers, several = self.registers[0x14 + channel], self.registers[0x1B] >> 15
            reference_hz, coil_hz = CLOCK_HZ / (dividers & 0x3FF), self.hz[channel] / (dividers >> 12)
            assert reference_hz <= (40e6 if several else 35e6) and coil_hz < reference_hz / 4
            assert 16 * self.registers[0x08 + channel] / reference_hz == pytest.approx(0.004, rel=0.01)
            assert 16 * self.registers[0x10 + channel] / reference_hz == pytest.approx(2e-5, rel=0.1)
            assert self.registers[0x10 + channel] > 3 and self.registers[0x1E + channel] == 18 << 11
            word = round(coil_hz / reference_hz * 2**28) | (self.fault << 28)
            if not self.registers[0x19] >> 11:  # errors are not flagged
                word &= 2**28 - 1
            self.data[channel] = word
            self.registers[0x18] |= 1 << (3 - channel)

    def write(self, words):
        self.pointer = words[0]
        if len(words) == 3:
            if self.pointer == 0x1C and words[1] & 0x80:
                self.reset()
            assert self.pointer in (0x1C, 0x1A) or self.registers[0x1A] & 0x2000  # only asleep
            self.registers[self.pointer] = words[1] << 8 | words[2]

    def read(self):
        if self.pointer > 7:
            return self.registers[self.pointer]
        channel, low = divmod(self.pointer, 2)
        word = self.data.get(channel, 0)
        if low:
            self.registers[0x18] &= ~(1 << (3 - channel))
        return word & 0xFFFF if low else word >> 16


CHIPS = {}


class Bus:
    """A bus of smbus2, with real messages."""

    def __init__(self, number):
        self.number, self.fd = number, 100 + number

    def i2c_rdwr(self, *messages):
        assert len(messages) <= 42  # Linux takes no more
        for message in messages:
            chip = CHIPS.get((self.number, message.addr))
            if chip is None or chip.gone:
                raise OSError(errno.EREMOTEIO, "Remote I/O error")
            if message.flags & 1:
                assert message.len == 2
                message.buf[0], message.buf[1] = (x.to_bytes(1, "big") for x in divmod(chip.read(), 256))
            else:
                chip.write(list(message))


@pytest.fixture
def chips(monkeypatch):
    smbus2 = pytest.importorskip("smbus2", reason="pip install -e '.[i2c]'")
    CHIPS.clear()
    for (bus, address, channel), hz in zip(AT, HZ, strict=True):
        CHIPS.setdefault((bus, address), Chip({})).hz[channel] = hz
    limits = []
    monkeypatch.setattr(smbus2, "SMBus", Bus)
    monkeypatch.setattr(ldc1612.fcntl, "ioctl", lambda *call: limits.append(call))
    CHIPS["limits"] = limits
    return [chip for at, chip in CHIPS.items() if at != "limits"]


def test_frequencies_of_each_channel(chips):
    springs = LdcSprings(AT, timeout_s=BUSY_S)
    assert sorted(CHIPS["limits"]) == [(101, 0x0702, 1), (103, 0x0702, 1)]  # a transfer ends within 10 ms
    assert np.isnan(springs.read_sensors()).all()  # no conversion has ended
    for chip in chips:
        chip.convert()
    np.testing.assert_allclose(springs.read_sensors(), HZ, atol=0.1)
    assert np.isnan(springs.read_sensors()).all()  # none is new
    chips[0].convert(only=[1])
    found = springs.read_sensors()
    assert found[1] == pytest.approx(HZ[1], abs=0.1) and np.isnan(np.delete(found, 1)).all()


@pytest.mark.parametrize("flag", [8, 4, 2, 1])
def test_a_reading_with_an_error_is_none(flag, chips):
    springs = LdcSprings(AT, timeout_s=BUSY_S)
    chips[1].fault = flag
    for chip in chips:
        chip.convert()
    np.testing.assert_array_equal(np.isnan(springs.read_sensors()), [at[:2] == (1, 0x2B) for at in AT])


def test_a_converter_that_is_gone_or_has_begun_anew_leaves_the_others(chips):
    springs = LdcSprings(AT, timeout_s=BUSY_S)
    chips[0].gone = True
    chips[2].reset()  # its supply broke down: it sleeps
    for chip in chips:
        chip.convert()
    np.testing.assert_array_equal(
        np.isnan(springs.read_sensors()), [True, True, False, True, True, True, True]
    )


def test_a_bus_that_hangs_does_not_hold_up_the_loop(chips, monkeypatch):
    springs, tried = LdcSprings(AT), []

    def hangs(self, *messages):
        tried.append(self.number)
        time.sleep(0.01)  # what the kernel waits at most
        raise TimeoutError(errno.ETIMEDOUT, "Connection timed out")

    monkeypatch.setattr(Bus, "i2c_rdwr", hangs)
    assert np.isnan(springs.read_sensors()).all()
    assert len(tried) == 1  # not one transfer for each converter


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ([1, 0x2A, 0], "channels: got 1, expected bus, address and channel"),
        ([[1, "0x2A", 0]], "expected bus, address and channel"),
        ([(1, 0x2A, 0), (1, 0x2A, 0)], "expected a channel 0 to 3 of its own"),
        ([(2, 0x2A, 0)], "bus 2, address 0x2a: got Remote I/O error"),
        ([(1, 0x2A, 0)], r"got ids \[21577, 12372\], expected \[21577, 12373\]"),
    ],
)
def test_channels_that_are_not_there(channels, message, chips):
    chips[0].registers[0x7F] = 0x3054  # of another chip
    with pytest.raises((OSError, ValueError), match=message):
        LdcSprings(channels)
    with pytest.raises(ValueError, match="drive_current: got 32, expected 0 to 31"):
        LdcSprings(AT, 32)
