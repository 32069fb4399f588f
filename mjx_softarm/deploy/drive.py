"""Drives of an arm to rest, without a policy. NumPy only.

A law turns spring lengths into the next pressures. `ramp` moves the pressures themselves, after a step.
`Hold` is the sensor-space law on references that move in step: the arm passes the shapes between the first
and the last.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_softarm.control import Gains, LawState, at_chambers, pressures
from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.belief import read_lengths
from mjx_softarm.deploy.link import LOST_TICKS, VENT_KPA_PER_S, ArmFault, Link
from mjx_softarm.policy.lag import SETTLE_TIMEOUT_S, WINDOW_S, still
from mjx_softarm.spec import ArmSpec

RAMP_M_PER_S = 0.03  # speed of the reference with the longest way
HELD_M = 1e-4  # largest mean error of a held spring; ten times the mean's noise, 3 mm at the tip at worst
MEAN_S = 0.2  # time constant of that running mean

# Law: spring lengths (n_springs,) [m], None if one was lost, and pressures in force (n_chambers,) [kPa]
# -> pressures to write, and whether the target is reached.
Law = Callable[[np.ndarray | None, np.ndarray], tuple[np.ndarray, bool]]


def ramp(target_kpa: np.ndarray, dt_s: float, step_kpa: float = 0.0) -> Law:
    """Return the law that takes the pressures to targets (n_chambers,) [kPa] as slowly as venting does.

    It begins with a step of up to `step_kpa`.
    """
    next_kpa = step_kpa + VENT_KPA_PER_S * dt_s  # change of the next tick

    def law(_spring_m: np.ndarray | None, in_force_kpa: np.ndarray) -> tuple[np.ndarray, bool]:
        nonlocal next_kpa
        change_kpa, next_kpa = next_kpa, VENT_KPA_PER_S * dt_s
        arrived = np.array_equal(in_force_kpa, target_kpa)
        return np.clip(target_kpa, in_force_kpa - change_kpa, in_force_kpa + change_kpa), arrived

    return law


class Hold:
    """Sensor-space law from the first lengths to references (n_springs,) [m]."""

    def __init__(self, gains: Gains, reference_m: np.ndarray, dt_s: float):
        self._gains = gains
        self._goal_m = np.asarray(reference_m, float)
        self._dt_s = dt_s
        self.reference_m: np.ndarray | None = None  # on its way; None before the first reading
        self._state: Any = None
        self._off_m: Any = np.inf  # (n_springs,) running mean of the error

    def __call__(self, spring_m: np.ndarray | None, in_force_kpa: np.ndarray) -> tuple[np.ndarray, bool]:
        # The first lengths are the first references; a lost reading changes nothing.
        if spring_m is None:
            return in_force_kpa, False
        if self.reference_m is None:
            self.reference_m = spring_m
            self._state = LawState.at_rest(in_force_kpa, spring_m)
            self._off_m = spring_m - self._goal_m
        # References a tick further, pressures, running mean of the error
        left_m = self._goal_m - self.reference_m
        steps = np.abs(left_m).max() / (RAMP_M_PER_S * self._dt_s)
        self.reference_m = self.reference_m + left_m / max(1.0, steps)
        pressure_kpa, self._state = pressures(
            self.reference_m, spring_m, self._state, self._gains, self._dt_s
        )
        self._off_m = self._off_m + self._dt_s / MEAN_S * (spring_m - self._goal_m - self._off_m)
        held = np.abs(at_chambers(self._off_m, self._gains.allocation)) < HELD_M
        return pressure_kpa, steps <= 1.0 and bool(np.all(held))


class Drive:
    """Drive of one arm, without pressure at first; `on_tick` takes the row of each tick."""

    def __init__(self, arm: ArmIO, spec: ArmSpec, on_tick: Callable[[dict], None] = lambda row: None):
        self.on_tick = on_tick
        self.spec = spec
        self.sensor = spec.spring_sensor
        self.gains = Gains.from_spec(spec)
        self.dt_s = 1.0 / spec.control.rate_hz
        self.window = max(2, round(WINDOW_S * spec.control.rate_hz))
        self.link = Link(arm, spec, self.dt_s)
        self.n_lost = 0

    def to_rest(
        self, law: Law, held: Callable[[], bool] = lambda: True, timeout_s: float = SETTLE_TIMEOUT_S
    ) -> dict | None:
        """Drive until the springs are at rest and the law has held its target for long enough.

        Motion capture that misses the arm at rest gets one more window.

        Returns:
            The row of the last tick; None after a timeout.

        Raises:
            ArmFault: the arm cannot be reached, or too many readings were lost in a row.
        """
        n_unseen = 0
        springs_m = np.empty((0, self.spec.n_springs))
        for _ in range(round(timeout_s / self.dt_s)):
            row, spring_m, arrived = self._tick(law)
            if spring_m is None or not arrived:
                springs_m = springs_m[:0]
                continue
            # At rest for a window, and seen so where the arm has motion capture.
            springs_m = np.vstack([springs_m, spring_m])[-self.window :]
            if len(springs_m) == self.window and still(springs_m) and held():
                n_unseen += 1
                if not self.link.sees or "tip_m" in row or n_unseen > self.window:
                    return row
        return None

    def _tick(self, law: Law) -> tuple[dict, np.ndarray | None, bool]:
        """Return the row, the spring lengths (n_springs,) if none was lost, whether the law has arrived."""
        begin_s = self.link.now()
        readings, row = self.link.read(begin_s)
        nothing = np.full(self.spec.n_springs, np.nan)
        spring_m, lost, text = read_lengths(self.sensor, readings, nothing)
        self.n_lost = self.n_lost + 1 if lost.any() else 0
        known_m = None if lost.any() else spring_m
        try:
            if self.n_lost >= LOST_TICKS:
                got = f"got {self.n_lost} lost readings in a row, expected under {LOST_TICKS}"
                raise ArmFault(f"sensors: {got}: {text}")
            pressure_kpa, arrived = law(known_m, self.link.pressure_kpa)
            self.link.write(pressure_kpa)
        finally:
            self.on_tick(row)
        self.link.wait_until(begin_s + self.dt_s)
        return row, known_m, arrived
