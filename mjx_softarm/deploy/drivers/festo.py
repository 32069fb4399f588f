"""Pressure regulators with a set point of 0 to 10 V at a Festo CPX-E terminal; needs festo-cpx-io.

Each chamber has a proportional regulator, such as a Festo VEAB or VPPE, an SMC ITV. Its set point comes from
an analogue output module (CPX-E-4AO-U-I), its measured pressure, if wired, goes to an input module
(CPX-E-4AI-U-I). Chamber k is channel k of the modules of a kind, in their order; modules of a kind stand side
by side. A tick takes one Modbus request for all set points and one for all measured pressures.

A second after the last request, also after a command's normal end, the terminal puts its outputs into their
fail state. By default this is 0 V: the strongest vacuum of a regulator whose range begins below zero. In
Festo's software set the fail state of each output to the voltage of 0 kPa: 5 V for -100 to 100 kPa.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjx_softarm._support.errors import needing

COUNTS = 27648  # number for 10 V, in the data format "sign + 15 bit"
UP_TO_10_V = 1  # setting of a channel's range
SILENT_S = 1.0  # time after which the terminal takes the computer for gone
N_OUT, N_IN = 4, 5  # registers of an output and of an input module; the last one of an input is its status


class CpxRegulators:
    """Regulators at a CPX-E terminal.

    Args:
        host: address of the terminal.
        modules: its type code, as printed on it, such as `60E-EP-3NO3NI`: three output and three input
            modules.
        n: number of chambers.
        range_kpa: pressures [kPa] of all regulators at 0 and 10 V, with 0 kPa between them.
        timeout_s: longest time for a request.

    Raises:
        InputError: festo-cpx-io is missing.
        ValueError: the range has no 0 kPa, the modules have too few channels, or do not stand side by side.
        OSError: the terminal cannot be reached.
    """

    def __init__(
        self, host: str, modules: str, n: int, range_kpa: Sequence[float], timeout_s: float = 0.006
    ) -> None:
        with needing("festo", "cpx-e"):
            terminal = importlib.import_module("cpx_io.cpx_system.cpx_e.cpx_e")
            base = importlib.import_module("cpx_io.cpx_system.cpx_base")
            self._errors: Any = importlib.import_module("pymodbus.exceptions")
        if len(range_kpa) != 2 or not range_kpa[0] <= 0.0 <= range_kpa[1] or range_kpa[0] == range_kpa[1]:
            raise ValueError(f"range_kpa: got {[*range_kpa]}, expected two rising numbers, 0 between them")
        self._n, (self._low_kpa, self._high_kpa) = n, range_kpa

        # The terminal and its channels; setting them may take a second
        try:
            self._cpx: Any = terminal.CpxE(modules, SILENT_S, ip_address=host)
        except (base.CpxConnectionError, ConnectionError, TypeError) as error:
            raise OSError(f"{host}: got {error}, expected a CPX-E terminal of type {modules}") from error
        try:
            outputs, self._output = self._modules("CpxE4AoUI", "outputs", N_OUT)
            inputs, self._input = self._modules("CpxE4AiUI", "inputs", N_IN)
            if self._output is None:
                raise ValueError(f"modules: got {modules}, expected analogue outputs, NO, for {n} chambers")
            # After power-up the set points are 0 V, which may be a vacuum: first 0 kPa, then the ranges.
            self.write_pressures(np.zeros(n))
            for modules_of_kind in filter(None, (outputs, inputs)):
                for k in range(n):
                    modules_of_kind[k // N_OUT].configure_channel_range(k % N_OUT, UP_TO_10_V)
        except Exception:
            self._cpx.shutdown()
            raise
        if self._input is not None:
            self.pressures = self._pressures  # an arm without this method measures none

        # From here on a request takes a part of a tick at most, and is not repeated
        self._cpx.client.comm_params.timeout_connect = timeout_s
        self._cpx.client.transaction.retries = 0

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Set the regulators' pressures (n,) [kPa]; see `ArmIO`."""
        kpa = np.asarray(pressure_kpa, float)
        if kpa.shape != (self._n,) or not ((self._low_kpa <= kpa) & (kpa <= self._high_kpa)).all():
            expected = f"{self._n} of {self._low_kpa:g} to {self._high_kpa:g}"
            raise ValueError(f"pressures: got {kpa} kPa, expected {expected}")
        share = (kpa - self._low_kpa) / (self._high_kpa - self._low_kpa)
        self._asked("write_registers", self._output, [round(COUNTS * x) for x in share])

    def _pressures(self) -> np.ndarray:
        """Return the measured pressures (n,) [kPa], NaN where they did not come in time; see `ArmIO`."""
        n_modules = -(-self._n // N_OUT)
        try:
            words = self._asked("read_holding_registers", self._input, count=n_modules * N_IN)
        except TimeoutError:
            return np.full(self._n, np.nan)
        counts = np.array(words, np.uint16).view(np.int16).reshape(n_modules, N_IN)[:, :-1].ravel()[: self._n]
        return self._low_kpa + counts / COUNTS * (self._high_kpa - self._low_kpa)

    def _modules(self, kind: str, side: str, n_registers: int) -> tuple[list[Any], int | None]:
        """Return the chambers' modules of a kind, and their first register, or None without any.

        Raises ValueError where there are too few, or where they do not stand side by side.
        """
        modules = [module for module in self._cpx.modules if type(module).__name__ == kind]
        if not modules:
            return [], None
        modules = modules[: -(-self._n // N_OUT)]
        registers = [getattr(module.system_entry_registers, side) for module in modules]
        if len(modules) * N_OUT < self._n or (np.diff(registers) != n_registers).any():
            expected = f"modules side by side for {self._n} chambers"
            raise ValueError(f"modules: got {len(modules)} of {kind} at {registers}, expected {expected}")
        return modules, registers[0]

    def _asked(self, method: str, *args: Any, **options: Any) -> list[int]:
        """Send a request; return the registers of its answer.

        Raises:
            TimeoutError: no answer came in time.
            OSError: the terminal cannot be reached, or refuses the request.
        """
        try:
            answer = getattr(self._cpx.client, method)(*args, **options)
        except self._errors.ConnectionException as error:
            raise ConnectionError(f"{self._cpx.ip_address}: got {error}, expected an answer") from error
        except self._errors.ModbusException as error:
            raise TimeoutError(f"{self._cpx.ip_address}: got {error}, expected an answer in time") from error
        if answer.isError():
            raise OSError(f"{self._cpx.ip_address}: got the Modbus error {answer}, expected an answer")
        return answer.registers
