"""Random safe poses of an arm, logged for calibration. NumPy only: the arm need not be known yet.

The pressures are drawn as those of the poses that policies are trained on; from one set to the next goes a
ramp. A pose is logged when the springs have come to rest, or, with `transients`, every tick is. The columns
are the control loop's without references, goals and estimates.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.faults import LOST_TICKS, SETTLE_TIMEOUT_S, still
from mjx_softarm.deploy.loop import VENT_KPA_PER_S, WINDOW_S
from mjx_softarm.deploy.session import ArmLost, Clock, Pumps, Recorder, read
from mjx_softarm.logs import Log
from mjx_softarm.sensors import SensorFault, SensorParams, describe_faults, length_from_frequency
from mjx_softarm.spec import ArmSpec


class Recording(NamedTuple):
    """What was logged."""

    log: Log
    n_poses: int  # that came to rest
    n_unsettled: int  # that did not within SETTLE_TIMEOUT_S; not logged, transients apart
    problem: str  # why it ended early, or ""


class _Stop(Exception):
    """The recording ends; the message says why."""


def record(
    arm: ArmIO,
    spec: ArmSpec,
    targets_kpa: np.ndarray,
    transients: bool = False,
    tell: Callable[[str], None] = lambda text: None,
) -> Recording:
    """Drive an arm through pressures, log it, and vent; Ctrl-C vents and keeps the log.

    Args:
        arm: without pressure, as its driver gives it.
        spec: the arm, for its rate, its limits and the range of its sensors.
        targets_kpa (m, n) [kPa]: one set of pressures after the other.
        transients: log every tick instead of the poses at rest.
        tell: takes a line now and then.
    """
    recorder = _Recording(arm, spec, transients)
    problem = ""
    try:
        for k, target_kpa in enumerate(targets_kpa):
            recorder.go(target_kpa)
            if (k + 1) % max(1, len(targets_kpa) // 10) == 0:
                tell(f"{k + 1} of {len(targets_kpa)} poses")
    except KeyboardInterrupt:
        problem = "interrupted"
    except (_Stop, ArmLost) as error:
        problem = str(error)
    try:
        recorder.vent()
    except (ArmLost, KeyboardInterrupt) as error:
        problem = f"{problem}; not vented: {str(error) or 'interrupted'}".removeprefix("; ")
    return Recording(recorder.rows.log("record"), recorder.n_poses, recorder.n_unsettled, problem)


class _Recording:
    """The mutable middle of `record`."""

    def __init__(self, arm: ArmIO, spec: ArmSpec, transients: bool):
        self.arm, self.transients = arm, transients
        self.sensor = SensorParams.from_spec(spec)
        self.dt_s = 1.0 / spec.control.rate_hz
        self.window = max(2, round(WINDOW_S * spec.control.rate_hz))
        self.clock, self.rows = Clock(arm), Recorder(arm)
        self.pumps = Pumps(arm, spec.n_chambers)
        self.n_lost = self.n_poses = self.n_unsettled = 0

    def go(self, target_kpa: np.ndarray) -> None:
        """Ramp to pressures (n,), and stay until the springs are at rest."""
        springs_m = np.empty((0, len(target_kpa)))
        for _ in range(round(SETTLE_TIMEOUT_S / self.dt_s)):
            arrived = np.array_equal(self.pumps.pressure_kpa, target_kpa)
            row, spring_m = self._tick(target_kpa)
            if self.transients:
                self.rows.add(row)
            if spring_m is None or not arrived:
                springs_m = springs_m[:0]
                continue
            springs_m = np.vstack([springs_m, spring_m])[-self.window :]
            if len(springs_m) == self.window and still(springs_m):
                self.n_poses += 1
                if not self.transients:
                    self.rows.add(row)
                return
        self.n_unsettled += 1

    def vent(self) -> None:
        """Ramp to zero."""
        while self.pumps.pressure_kpa.any():
            begin_s = self.clock.now()
            self._write(np.zeros_like(self.pumps.pressure_kpa))
            self.clock.wait_until(begin_s + self.dt_s)

    def _tick(self, target_kpa: np.ndarray) -> tuple[dict, np.ndarray | None]:
        """One row, and the spring lengths (n,) if none was lost; then a step towards the pressures."""
        begin_s = self.clock.now()
        frequency_hz = read(self.arm, len(target_kpa))
        row = self.rows.look(begin_s, self.pumps.pressure_kpa)
        text = "no readings within the tick"
        spring_m, lost = np.full(len(target_kpa), np.nan), True
        if frequency_hz is not None:
            reading = length_from_frequency(frequency_hz, self.sensor, np.nan)
            spring_m, lost = reading.length_m, bool(np.any(reading.fault != SensorFault.OK.value))
            text = describe_faults(frequency_hz, reading.fault, self.sensor).replace("\n", "; ")
        row["frequency_hz"] = spring_m * np.nan if frequency_hz is None else frequency_hz
        self.n_lost = self.n_lost + 1 if lost else 0
        if self.n_lost >= LOST_TICKS:
            raise _Stop(f"readings lost in {self.n_lost} ticks in a row: {text}")
        self._write(target_kpa)
        self.clock.wait_until(begin_s + self.dt_s)
        return row, None if lost else spring_m

    def _write(self, target_kpa: np.ndarray) -> None:
        step_kpa = VENT_KPA_PER_S * self.dt_s
        in_force_kpa = self.pumps.pressure_kpa
        self.pumps.write(np.clip(target_kpa, in_force_kpa - step_kpa, in_force_kpa + step_kpa))
