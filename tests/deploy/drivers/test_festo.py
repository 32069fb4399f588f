"""Regulators at a CPX-E terminal: a stand-in that speaks Modbus TCP by its specification, faults included."""

import contextlib
import functools
import socket
import struct
import threading
import time

import numpy as np
import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.drivers.names import open_arm

# Registers of "60E-EP-3NO3NI": the bus module has two outputs and three inputs, an output module four outputs
# and five inputs (four echoes, status), an input module five inputs.
CONTROL, DATA_OUT, OUTPUTS, CONTROL_IN, DATA_IN, INPUTS, TIMEOUT = (
    40001,
    40002,
    40003,
    45392,
    45393,
    45410,
    46100,
)
FULL = 27648  # 10 V
TOML = """
[springs]
driver = "ldc1612"
channels = []

[pressures]
driver = "cpx-e"
host = "127.0.0.1"
modules = "60E-EP-3NO3NI"
n = 9
range_kpa = [-100.0, 100.0]
"""


class Terminal:
    """A terminal whose regulators reach their set points at once, and whose faults are attributes."""

    def __init__(self):
        self.registers = np.zeros(65536, int)
        self.parameters = dict.fromkeys(range(4096, 8192), 0)
        self.counts_at_ranges = []  # of the outputs, each time that a channel's range is set
        self.silent, self.refuses, self.delay_s, self.n_requests = False, False, 0.0, 0
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.settimeout(0.02)
        self.port, self.ends = self.listener.getsockname()[1], threading.Event()
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    def serve(self):
        with self.listener:
            while not self.ends.is_set():
                with contextlib.suppress(OSError):
                    client = self.listener.accept()[0]
                    with client:
                        self.talk(client)

    def talk(self, client):
        client.settimeout(0.02)
        data = b""
        while not self.ends.is_set():
            with contextlib.suppress(TimeoutError):
                if not (new := client.recv(4096)):
                    return
                data += new
            while len(data) >= 7 and len(data) >= (end := 6 + struct.unpack(">H", data[4:6])[0]):
                number, unit = struct.unpack(">H4xB", data[:7])
                answer, data = self.answer(data[7:end]), data[end:]
                time.sleep(self.delay_s)
                if not self.silent:
                    client.sendall(struct.pack(">HHHB", number, 0, len(answer) + 1, unit) + answer)

    def answer(self, request):
        self.n_requests += 1
        kind, address, value = struct.unpack(">BHH", request[:5])
        if self.refuses:
            return bytes([kind | 0x80, 2])  # illegal address
        if kind == 3:  # read holding registers
            return bytes([kind, 2 * value]) + self.words[address : address + value].astype(">u2").tobytes()
        words = [value] if kind == 6 else np.frombuffer(request[6:], ">u2")
        for k, word in enumerate(words):
            self.write(address + k, int(word))
        return request[:5]

    @property
    def words(self):
        words = self.registers.copy()
        for k in range(9):
            words[INPUTS + k // 4 * 5 + k % 4] = words[OUTPUTS + k]
        return words

    def write(self, address, word):
        self.registers[address] = word
        if address == CONTROL:  # a parameter is read, or written with bit 13, and bit 15 answers bit 15
            number = word & 0x1FFF
            if word & 0x2000:
                self.parameters[number] = int(self.registers[DATA_OUT])
                self.counts_at_ranges.append(self.registers[OUTPUTS : OUTPUTS + 9].copy())
            elif word:
                self.registers[DATA_IN] = self.parameters[number]
            self.registers[CONTROL_IN] = word & 0x8000

    def close(self):
        self.ends.set()
        self.thread.join()


@pytest.fixture
def terminal(monkeypatch, request):
    base = pytest.importorskip("cpx_io.cpx_system.cpx_base", reason="pip install -e '.[festo]'")
    made = Terminal()
    request.addfinalizer(made.close)
    monkeypatch.setattr(base, "ModbusTcpClient", functools.partial(base.ModbusTcpClient, port=made.port))
    return made


@pytest.fixture
def opened(terminal, tmp_path, monkeypatch, request):
    from mjx_softarm.deploy.drivers import wiring

    monkeypatch.setitem(wiring.DRIVERS["springs"], "ldc1612", lambda channels: None)

    def make(text=TOML):
        (tmp_path / "wiring.toml").write_text(text)
        arm = open_arm(str(tmp_path / "wiring.toml"))
        request.addfinalizer(arm._pressures._cpx.shutdown)
        return arm

    return make


def test_pressures_go_to_the_terminal_and_come_back(opened, terminal):
    arm = opened()
    assert terminal.registers[TIMEOUT] == 1000  # ms, after which the outputs fail
    # Ranges of the channels of module m, here 0 to 10 V, two in each number: from function number
    # 4828 + 64 m + 11 of outputs, 13 of inputs
    for module in range(1, 7):
        first = 4828 + 64 * module + (11 if module <= 3 else 13)
        ranges = [terminal.parameters[first], terminal.parameters[first + 1]]
        assert ranges == ([0x01, 0] if module in (3, 6) else [0x11, 0x11])
    kpa = np.array([-100.0, -40.0, 0.0, 20.0, 100.0, 1.0, -1.0, 50.0, -50.0])
    terminal.n_requests = 0
    arm.write_pressures(kpa)
    counts = (kpa + 100.0) / 200.0 * FULL
    np.testing.assert_allclose(terminal.registers[OUTPUTS : OUTPUTS + 9], counts, atol=0.5)
    np.testing.assert_allclose(arm.pressures(), kpa, atol=200.0 / FULL)
    assert terminal.n_requests == 2


@pytest.mark.parametrize(("range_kpa", "counts"), [((-100.0, 100.0), FULL // 2), ((-25.0, 75.0), FULL // 4)])
def test_the_set_points_are_0_kpa_before_the_channels_have_ranges(range_kpa, counts, opened, terminal):
    opened(TOML.replace("[-100.0, 100.0]", str([*range_kpa])))
    assert len(terminal.counts_at_ranges) >= 9
    for found in (*terminal.counts_at_ranges, terminal.registers[OUTPUTS : OUTPUTS + 9]):
        np.testing.assert_array_equal(found, counts)


def test_pressures_beyond_the_regulators_are_not_sent(opened, terminal):
    arm = opened()
    before = terminal.registers.copy()
    for wrong in (np.full(9, 100.1), np.full(9, np.nan), np.zeros(8)):
        with pytest.raises(ValueError, match="expected 9 of -100 to 100"):
            arm.write_pressures(wrong)
    np.testing.assert_array_equal(terminal.registers, before)


def test_late_and_lost_answers_do_not_hold_up_the_loop_nor_are_they_taken_for_others(opened, terminal):
    arm = opened(TOML + "timeout_s = 0.02\n")
    arm.write_pressures(np.full(9, -10.0))
    terminal.silent = True
    begin_s = time.monotonic()
    assert np.isnan(arm.pressures()).all()
    with pytest.raises(TimeoutError, match=r"127.0.0.1: got .*, expected an answer in time"):
        arm.write_pressures(np.full(9, -20.0))
    assert time.monotonic() - begin_s < 0.2
    terminal.silent, terminal.delay_s = False, 0.04
    assert np.isnan(arm.pressures()).all()  # its answer comes while the next one is waited for
    terminal.delay_s = 0.0
    time.sleep(0.1)
    for kpa in (-30.0, -35.0, 0.0):
        for _ in range(5):
            try:
                arm.write_pressures(np.full(9, kpa))
                break
            except TimeoutError:
                time.sleep(0.02)
        found = arm.pressures()
        assert np.isnan(found).all() or np.abs(found - kpa).max() < 0.01
    assert (terminal.registers[OUTPUTS : OUTPUTS + 9] == FULL // 2).all()  # vented


def test_a_terminal_that_refuses_or_goes_ends_the_run(opened, terminal):
    arm = opened()
    terminal.refuses = True
    with pytest.raises(OSError, match="got the Modbus error"):
        arm.write_pressures(np.zeros(9))
    terminal.refuses = False
    terminal.close()
    begin_s = time.monotonic()
    for _ in range(20):
        with pytest.raises(OSError):
            arm.write_pressures(np.zeros(9))
    assert time.monotonic() - begin_s < 20 * 0.02 + 0.2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("3NO3NI", "NO3NI", "got 1 of CpxE4AoUI at .*, expected modules side by side for 9 chambers"),
        ("3NO3NI", "NOLNONO3NI", "expected modules side by side"),
        ("3NO3NI", "3NI", "expected analogue outputs, NO, for 9 chambers"),
        ("60E-EP-3NO3NI", "60N-M", "expected a CPX-E terminal of type 60N-M"),
        ("[-100.0, 100.0]", "[100.0, -100.0]", "expected two rising numbers, 0 between them"),
        ("[-100.0, 100.0]", "[10.0, 100.0]", "expected two rising numbers, 0 between them"),
        ("[-100.0, 100.0]", "[0.0, 0.0]", "expected two rising numbers, 0 between them"),
        ("[-100.0, 100.0]", "[100.0]", r"range_kpa: got \[100.0\], expected two rising numbers"),
        ("n = 9", "m = 9", "unexpected keyword argument 'm'"),
    ],
)
def test_settings_that_do_not_fit(old, new, message, opened):
    with pytest.raises(InputError, match=rf"--arm .*wiring.toml: pressures: got .*{message}"):
        opened(TOML.replace(old, new))


def test_a_terminal_without_inputs_measures_no_pressures(opened):
    arm = opened(TOML.replace("3NO3NI", "3NO"))
    arm.write_pressures(np.zeros(9))
    assert not hasattr(arm, "pressures")


def test_a_terminal_that_is_not_there(opened, terminal):
    terminal.close()
    with pytest.raises(InputError, match=r"pressures: got (OSError|\w+Error): .*127.0.0.1"):
        opened()
