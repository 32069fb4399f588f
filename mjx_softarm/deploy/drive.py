"""Drive an arm by any law, tick by tick, until its springs are at rest. NumPy only: for real arms, too.

A law takes spring lengths to the pressures to write next. Here are a ramp of the pressures themselves, and
the sensor-space law on references that move there along a ramp, all in step, so that the arm bends from one
shape to the next by way of those between.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_softarm.control import Gains, LawState, pressures
from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.belief import read_lengths, still
from mjx_softarm.deploy.controller import LOOP
from mjx_softarm.deploy.link import VENT_KPA_PER_S, ArmFault, Link
from mjx_softarm.spec import ArmSpec

RAMP_M_PER_S = 0.03  # of the reference that has furthest to go
# A spring is on its reference when its error's running mean is this small: errors of springs add up along the
# arm to thirty times as much at its tip. The noise of such a mean is a tenth of it.
HELD_M, MEAN_S = 1e-4, 0.2

# Spring lengths (n,) [m], None where one was lost, and pressures in force (n,) [kPa] -> pressures to write,
# and whether the law has reached its target.
Law = Callable[[np.ndarray | None, np.ndarray], tuple[np.ndarray, bool]]


def ramp(target_kpa: np.ndarray, dt_s: float) -> Law:
    """Return the law that reaches pressures (n,) [kPa] along a ramp that is safe for the arm."""
    step_kpa = VENT_KPA_PER_S * dt_s

    def law(_spring_m: np.ndarray | None, in_force_kpa: np.ndarray) -> tuple[np.ndarray, bool]:
        arrived = np.array_equal(in_force_kpa, target_kpa)
        return np.clip(target_kpa, in_force_kpa - step_kpa, in_force_kpa + step_kpa), arrived

    return law


class Hold:
    """Sensor-space law, from the springs as they are first read to references (n,) [m]."""

    def __init__(self, gains: Gains, reference_m: np.ndarray, dt_s: float):
        self._gains, self._goal_m, self._dt_s = gains, np.asarray(reference_m, float), dt_s
        self.reference_m: np.ndarray | None = None  # on its way; None before the first reading
        self._state: Any = None
        self._off_m: Any = np.inf  # running mean

    def __call__(self, spring_m: np.ndarray | None, in_force_kpa: np.ndarray) -> tuple[np.ndarray, bool]:
        if spring_m is None:
            return in_force_kpa, False
        if self.reference_m is None:
            self.reference_m, self._state = spring_m, LawState.at_rest(in_force_kpa, spring_m)
            self._off_m = spring_m - self._goal_m
        left_m = self._goal_m - self.reference_m
        steps = np.abs(left_m).max() / (RAMP_M_PER_S * self._dt_s)
        self.reference_m = self.reference_m + left_m / max(1.0, steps)
        pressure_kpa, self._state = pressures(
            self.reference_m, spring_m, self._state, self._gains, self._dt_s
        )
        self._off_m = self._off_m + self._dt_s / MEAN_S * (spring_m - self._goal_m - self._off_m)
        return pressure_kpa, steps <= 1.0 and bool(np.all(np.abs(self._off_m) < HELD_M))


class Drive:
    """Drive of one arm, which is without pressure at first, as its driver gives it.

    Args:
        arm: sensors and pumps.
        spec: the arm, for its rate and its sensors.
        on_tick: takes what there is to log of every tick.
    """

    def __init__(self, arm: ArmIO, spec: ArmSpec, on_tick: Callable[[dict], None] = lambda row: None):
        self.on_tick = on_tick
        self.sensor, self.gains = spec.spring_sensor, Gains.from_spec(spec)
        self.dt_s = 1.0 / spec.control.rate_hz
        self.window = max(2, round(LOOP.window_s * spec.control.rate_hz))
        self.link = Link(arm, spec.n_chambers, self.dt_s)
        self.n_lost = 0

    def to_rest(
        self, law: Law, held: Callable[[], bool] = lambda: True, timeout_s: float = LOOP.settle_timeout_s
    ) -> dict | None:
        """Drive until the springs are at rest where the law wants them.

        Where the arm has motion capture, it is given another window to see the arm at rest.

        Args:
            law: takes the arm there.
            held: returns whether the arm has been there for long enough.
            timeout_s: longest time that this may take.

        Returns:
            What there is to log of the last tick; None if it took longer.

        Raises:
            ArmFault: the arm cannot be reached, or too many readings were lost in a row.
        """
        n_unseen = 0
        springs_m = np.empty((0, len(self.link.pressure_kpa)))
        for _ in range(round(timeout_s / self.dt_s)):
            row, spring_m, arrived = self._tick(law)
            if spring_m is None or not arrived:
                springs_m = springs_m[:0]
                continue
            springs_m = np.vstack([springs_m, spring_m])[-self.window :]
            if len(springs_m) == self.window and still(springs_m) and held():
                n_unseen += 1
                if not self.link.sees or "tip_m" in row or n_unseen > self.window:
                    return row
        return None

    def _tick(self, law: Law) -> tuple[dict, np.ndarray | None, bool]:
        """Return the row, the spring lengths (n,) if none was lost, and whether the law has arrived."""
        begin_s = self.link.now()
        nothing = np.full(len(self.link.pressure_kpa), np.nan)
        readings = self.link.read()
        row = self.link.look(begin_s)
        spring_m, lost, text = read_lengths(self.sensor, readings, nothing)
        row["readings"] = nothing if readings is None else readings
        self.n_lost = self.n_lost + 1 if lost.any() else 0
        known_m = None if lost.any() else spring_m
        try:
            most = LOOP.lost_ticks
            if self.n_lost >= most:
                raise ArmFault(
                    f"sensors: got {self.n_lost} lost readings in a row, expected under {most}: {text}"
                )
            pressure_kpa, arrived = law(known_m, self.link.pressure_kpa)
            self.link.write(pressure_kpa)
        finally:
            self.on_tick(row)
        self.link.wait_until(begin_s + self.dt_s)
        return row, known_m, arrived
