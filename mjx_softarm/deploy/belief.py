"""Belief about an arm, made of readings and pressures: lengths, payload, pose, rest, doubtful parts.

    readings                   -> spring lengths, the last good ones where a reading is lost
    motion of the springs      -> hysteresis of the chambers
    springs, hysteresis and pressures at rest -> payload
    springs, payload           -> pose of the tip (estimator, then sim-to-real network)

Pure functions; NumPy only. Tests of windows take the symbols of `mjx_softarm.export`, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.control import Gains, LawState, allocated_error, at_chambers, saturated
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.lag import ARRIVED_M, still
from mjx_softarm.policy.runtime import tip_pose
from mjx_softarm.sensing.estimator import SpringModel, expected_springs
from mjx_softarm.sensing.hysteresis import stop_after
from mjx_softarm.sensing.load import KNOWN, Load, averaged, estimate_load, holds_payload
from mjx_softarm.sensing.sensors import Sensor
from mjx_softarm.spec import ArmSpec

STUCK_RANGE_M = 1e-5  # range of a stuck sensor over a window; a live one's noise is larger
STUCK_PRESSURE_KPA = 2.0  # range of its chamber's pressure at which a live one moves; by hand
STUCK_NEIGHBOUR_M = 2e-3  # motion of its section's springs at which a live one moves; by hand

# Lost chambers. By hand, and tested (tests/train/runs/test_estimator.py): no saturated simulated arm is taken
# for one that leaks; 95 % of lost chambers are detected, 85 % with 500 g.
LOST_SHARE = 0.5  # least share of the pressure that the arm's shape lacks
NO_AIR_SHARE = 1.5  # share of all pressures from which the shape is not that without air
EXPLAINED_SHARE = 0.7  # least share of the springs' squared deviations that this explains
LOST_EFFECT_M = 0.01  # least change at the chamber; tolerances and payloads look like less
_NO_EFFECT_M2 = 1e-18


class Command(NamedTuple):
    """References and pressures in force."""

    reference_m: np.ndarray | None  # (n_springs,) None: the pressures go to zero
    n_ticks: int  # ticks since the references or the goal were new
    law: LawState  # NaN lengths before the first reading
    pressure_kpa: np.ndarray  # (n_chambers,)

    @classmethod
    def none(cls, spec: ArmSpec) -> Command:
        """Return the command of an arm without pressure."""
        zero_kpa = np.zeros(spec.n_chambers)
        unknown_m = np.full(spec.n_springs, np.nan)
        return cls(None, 0, LawState.at_rest(zero_kpa, unknown_m), zero_kpa)


@dataclass(frozen=True, eq=False)
class Belief:
    """Belief about an arm; windows are of the last ticks, the newest last."""

    controller: Controller  # with the arm's models
    command: Command  # in force as the readings were taken
    window_m: np.ndarray  # (ticks, n_springs) lengths
    window_kpa: np.ndarray  # (ticks, n_chambers) pressures in force
    window_chamber_kpa: np.ndarray  # (ticks, n_chambers) pressures measured, or in force where none was
    spring_m: np.ndarray  # (n_springs,) lengths, the last good ones; NaN before the first
    n_lost: np.ndarray  # (n_springs,) ticks in a row without a reading of a spring
    n_suspect: np.ndarray  # (n_chambers,) ticks in a row in which a chamber seemed to have lost its pressure
    load: Load  # payload
    stop: np.ndarray  # (n_chambers,) states of the chambers' hysteresis
    n_late: int = 0  # ticks in a row that missed their deadline
    why_lost: str = ""  # message of the sensors
    estimate_kg: float | None = None  # payload by this tick's window alone; None: not estimated in this tick
    width_kg: float = 0.0  # half-width of the 95 % interval of `estimate_kg`
    n_unweighed: int = 0  # ticks since the payload was last estimated

    @classmethod
    def none(cls, controller: Controller) -> Belief:
        """Return the belief before the first tick."""
        spec = controller.policy.spec
        return cls(
            controller=controller,
            command=Command.none(spec),
            window_m=np.empty((0, spec.n_springs)),
            window_kpa=np.empty((0, spec.n_chambers)),
            window_chamber_kpa=np.empty((0, spec.n_chambers)),
            spring_m=np.full(spec.n_springs, np.nan),
            n_lost=np.zeros(spec.n_springs, int),
            n_suspect=np.zeros(spec.n_chambers, int),
            load=Load(spec.mass.payload_kg, assumed_kg=spec.mass.payload_kg),
            stop=np.zeros(spec.n_chambers),
        )

    @property
    def pose(self) -> np.ndarray:
        """Pose (6,) [mm, deg] of the tip, NaN before the first lengths."""
        return self._tip[0]

    @property
    def away(self) -> float:
        """Distance of the pose from the sim-to-real network's training rows, over the limit."""
        return self._tip[1]

    @cached_property
    def _tip(self) -> tuple[np.ndarray, float]:
        # Only when asked for: in most ticks after the pressures are written, for the log.
        if not self.known:
            return np.full(6, np.nan), 0.0
        pose, away = tip_pose(self.controller.policy, self.spring_m, self.load.believed_kg)
        return pose, float(away)

    @property
    def lost(self) -> np.ndarray:
        """Springs (n_springs,), bool, without a reading in this tick."""
        return self.n_lost > 0

    @property
    def known(self) -> bool:
        """True once each spring has been read."""
        return not np.isnan(self.spring_m).any()

    @property
    def mean_m(self) -> np.ndarray:
        """Mean lengths (n_springs,) [m] over the window."""
        return self.window_m.mean(axis=0)

    @cached_property
    def at_rest(self) -> bool:
        """True if nothing has moved for a window; one after the last action, at the earliest."""
        rest = self.controller.rest
        n_ticks = min(len(self.window_m), self.command.n_ticks)
        return n_ticks >= rest.window and bool(still(self.window_m, rest.still_m))

    @cached_property
    def settled(self) -> bool:
        """True at rest with each spring on its reference, or its chamber at a limit."""
        command = self.command
        if command.reference_m is None or not self.known or not self.at_rest:
            return False
        gains, arrived_m = self.controller.policy.gains, self.controller.rest.arrived_m
        return bool(on_reference(self.window_m, command.reference_m, command.pressure_kpa, gains, arrived_m))

    @cached_property
    def saturated(self) -> np.ndarray:
        """Chambers (n_chambers,), bool, at their limit, off their reference in the mean."""
        return _saturated(self, self.mean_m)

    @cached_property
    def stuck(self) -> np.ndarray:
        """Springs (n_springs,), bool, that stand stock-still where they should not."""
        if len(self.window_m) < self.controller.window:
            return np.zeros(len(self.spring_m), bool)
        return stuck_springs(self.window_m, self.window_kpa, self.controller.policy.spec.structure.n_sections)


def believe(
    last: Belief,
    command: Command,
    readings: np.ndarray | None,
    late: bool,
    measured_kpa: np.ndarray | None = None,
) -> Belief:
    """Return the belief of a tick from the last one and the command in force; see `loop.step`."""
    policy = last.controller.policy
    size = last.controller.window
    in_force_kpa = command.pressure_kpa

    # Lengths, and the windows that end with them
    spring_m, lost, why = read_lengths(policy.sensor, readings, last.spring_m)
    chamber_kpa = in_force_kpa
    if measured_kpa is not None:
        chamber_kpa = np.where(np.isfinite(measured_kpa), measured_kpa, in_force_kpa)
    belief = replace(
        last,
        command=command,
        window_m=np.vstack([last.window_m[1 - size :], spring_m]),
        window_kpa=np.vstack([last.window_kpa[1 - size :], in_force_kpa]),
        window_chamber_kpa=np.vstack([last.window_chamber_kpa[1 - size :], chamber_kpa]),
        spring_m=spring_m,
        n_lost=np.where(lost, last.n_lost + 1, 0),
        stop=hysteresis_after(policy, last.stop, last.spring_m, spring_m),
        n_late=last.n_late + 1 if late else 0,
        why_lost=why,
        estimate_kg=None,
        width_kg=0.0,
        n_unweighed=last.n_unweighed + 1,
    )

    # Chambers in doubt
    suspect = _saturated(belief, spring_m)
    if suspect.any():
        suspect &= explained_by_pressure_loss(policy.spring_model, in_force_kpa, spring_m, policy.gains)
    return _with_load(replace(belief, n_suspect=np.where(suspect, last.n_suspect + 1, 0)))


def _saturated(belief: Belief, spring_m: np.ndarray) -> np.ndarray:
    """Return which chambers (n_chambers,) are at their limit with these springs off their references."""
    policy, command = belief.controller.policy, belief.command
    if command.reference_m is None or not belief.known:
        return np.zeros(len(command.pressure_kpa), bool)
    return saturated(command.pressure_kpa, command.reference_m, spring_m, policy.gains, policy.tolerance_m)


def _with_load(belief: Belief) -> Belief:
    """Return the belief with the payload that an arm at rest shows, over windows that do not overlap.

    An estimate whose interval holds no payload leaves the specified payload. One that is not known well
    changes nothing.
    """
    doubtful = belief.lost.any() or belief.stuck.any() or belief.n_suspect.any()
    if not belief.at_rest or belief.n_unweighed < belief.controller.window or doubtful:
        return belief
    model = belief.controller.policy.load_estimator
    load = belief.load
    most_kg = float(model.load_scale_kg)
    mean_kpa = belief.window_chamber_kpa.mean(axis=0)
    estimate_kg, width_kg = map(float, estimate_load(model, belief.mean_m, mean_kpa, belief.stop))
    if not holds_payload(estimate_kg, width_kg, most_kg):
        load = Load(load.assumed_kg, assumed_kg=load.assumed_kg)
    elif width_kg <= KNOWN * most_kg:
        load = averaged(load, estimate_kg, width_kg, most_kg)
    return replace(belief, load=load, estimate_kg=estimate_kg, width_kg=width_kg, n_unweighed=0)


def hysteresis_after(policy: Policy, stop: Array, last_m: Array, spring_m: Array) -> Array:
    """Return the hysteresis (n_chambers,) after springs moved from lengths (n_springs,) [m] to others."""
    moved_m = at_chambers(spring_m - last_m, policy.gains.allocation)
    return stop_after(stop, moved_m, policy.load_estimator.stroke_m)


def pose_of(policy: Policy, spring_m: np.ndarray, load_kg: float) -> np.ndarray:
    """Return the tip pose (6,) [mm, deg] of springs (n_springs,) [m] with a payload."""
    return np.asarray(tip_pose(policy, spring_m, load_kg)[0], float)


def read_lengths(
    sensor: Sensor, readings: np.ndarray | None, last_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return lengths (n,) [m], the last ones of lost readings; a mask (n,) of these; and the reason."""
    if readings is None:
        return last_m, np.ones(len(last_m), bool), "no readings within the tick"
    length_m, lost = sensor.lengths(readings, last_m)
    return length_m, lost, "; ".join(sensor.describe_lost(readings, lost))


def on_reference(
    springs_m: Array, reference_m: Array, pressure_kpa: Array, gains: Gains, arrived_m: float = ARRIVED_M
) -> Array:
    """Return whether each spring is on its reference, in the mean of a window, or its chamber at a limit.

    Springs of an arm with redundant chambers cannot all be on any references: there the error that the law
    closes at each chamber counts.

    Args:
        springs_m (ticks, n_springs) [m]: lengths of the last ticks.
        reference_m (n_springs,) [m]: references.
        pressure_kpa (n_chambers,) [kPa]: commanded pressures.
        gains: numbers of the law.
        arrived_m: largest error of a spring on its reference.
    """
    xp = array_namespace(springs_m, reference_m, pressure_kpa)
    off_m = allocated_error(reference_m - xp.mean(springs_m, axis=0), pressure_kpa, gains.allocation)
    at_limit = (pressure_kpa <= gains.pressure_min_kpa) | (pressure_kpa >= gains.pressure_max_kpa)
    return xp.all((xp.abs(off_m) < arrived_m) | at_limit)


def stuck_springs(spring_m: Array, pressure_kpa: Array, n_sections: int) -> Array:
    """Return which springs (n_springs,) stand stock-still, noise included, where they should move.

    They should move if the chamber beside them was driven or a spring of their section moved.

    Args:
        spring_m (ticks, n_springs) [m]: lengths of the last ticks.
        pressure_kpa (ticks, n_chambers) [kPa]: commanded pressures of these ticks.
        n_sections: number of sections.
    """
    xp = array_namespace(spring_m)
    n_springs = spring_m.shape[1]
    beside_kpa = pressure_kpa[:, :: pressure_kpa.shape[1] // n_springs]  # every k-th chamber has a spring
    driven = _range(beside_kpa) > STUCK_PRESSURE_KPA
    section_m = xp.max(_range(spring_m).reshape(n_sections, -1), axis=1)[:, None]  # (n_sections, 1)
    near_m = (section_m + np.zeros(n_springs // n_sections)).reshape(-1)  # (n_springs,)
    return (_range(spring_m) < STUCK_RANGE_M) & (driven | (near_m > STUCK_NEIGHBOUR_M))


def _range(values: Array) -> Array:
    """Return the range (n,) of values (ticks, n)."""
    xp = array_namespace(values)
    return xp.max(values, axis=0) - xp.min(values, axis=0)


def explained_by_pressure_loss(
    model: SpringModel, pressure_kpa: Array, spring_m: Array, gains: Gains
) -> Array:
    """Return for which chambers (n_chambers,) a loss of pressure explains the arm's shape.

    The springs' deviations from the model's lengths are then, for the most part, a good share of the
    deviations that the pressure's absence makes. Redundant chambers make up for a lost one: the loss shows
    once one of them is at its limit. Without air all chambers come to a limit, and the loss of all pressures
    together explains the shape.

    Args:
        model: network of the unloaded arm.
        pressure_kpa (n_chambers,) [kPa]: commanded pressures.
        spring_m (n_springs,) [m]: lengths.
        gains: limits of the pressures; matrices of an arm with redundant chambers.
    """
    xp = array_namespace(pressure_kpa, spring_m)
    n = len(pressure_kpa)
    kept = np.concatenate([np.ones((1, n)), 1.0 - np.eye(n), np.zeros((1, n))]) > 0.0
    springs_m = expected_springs(model, xp.where(kept, pressure_kpa, 0.0))  # with all, without one, with none
    effect_m = springs_m[1:] - springs_m[0]  # (n_chambers + 1, n_springs)
    deviation_m = spring_m - springs_m[0]  # (n_springs,)
    size = xp.maximum(xp.sum(effect_m**2, axis=1), _NO_EFFECT_M2)  # zero where there is no pressure
    share = effect_m @ deviation_m / size  # (n_chambers + 1,)
    left_m = deviation_m - share[:, None] * effect_m
    explained = 1.0 - xp.sum(left_m**2, axis=1) / xp.sum(deviation_m**2)
    enough = (share > LOST_SHARE) & (explained > EXPLAINED_SHARE)
    chamber_m = share[:, None] * at_chambers(effect_m, gains.allocation)  # (n_chambers + 1, n_chambers)
    chamber_m = xp.abs(chamber_m)
    lost_m = xp.sum(xp.where(np.eye(n, dtype=bool), chamber_m[:-1], 0.0), axis=1)
    alone = enough[:-1] & (lost_m > LOST_EFFECT_M)
    at_limit = (pressure_kpa <= gains.pressure_min_kpa) | (pressure_kpa >= gains.pressure_max_kpa)
    no_air = enough[-1:] & (share[-1:] < NO_AIR_SHARE) & (xp.max(chamber_m[-1]) > LOST_EFFECT_M)
    return alone | (no_air & xp.all(at_limit))
