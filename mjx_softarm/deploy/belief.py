"""Belief about an arm: what its readings and pressures say of lengths, payload, pose, rest and trust.

    readings                   -> spring lengths, the last good ones where a reading is lost
    springs, pressures at rest -> payload
    springs, payload           -> pose of the tip (estimator, then sim-to-real network)

Pure functions; NumPy only. Tests of windows take the symbols of `mjx_softarm.export`, too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.control import Gains, saturated
from mjx_softarm.deploy.controller import LOOP, Command, Controller, LoopConfig
from mjx_softarm.policy.file import Policy
from mjx_softarm.sensing.estimator import SpringModel, expected_springs
from mjx_softarm.sensing.load import HIGHEST, LOWEST, Load, averaged, estimate_load
from mjx_softarm.sensing.sensors import Sensor, SensorFault
from mjx_softarm.spec import N_CHAMBERS_PER_SECTION


class Window(NamedTuple):
    """Last ticks of an arm with n springs and chambers, the newest last."""

    spring_m: np.ndarray  # (ticks, n) lengths
    pressure_kpa: np.ndarray  # (ticks, n) in force
    chamber_kpa: np.ndarray  # (ticks, n) measured, or in force where none was measured

    def with_tick(self, rows: tuple[np.ndarray, ...], most: int) -> Window:
        """Return the window with another tick, of at most so many."""
        return Window(*(np.concat([old[1 - most :], new[None]]) for old, new in zip(self, rows, strict=True)))


class Belief(NamedTuple):
    """Belief about an arm with n springs and chambers."""

    spring_m: np.ndarray  # (n,) lengths, the last good ones; NaN before the first
    lost: np.ndarray  # (n,) bool: a spring without a reading in this tick
    why_lost: str  # message of the sensors
    stuck: np.ndarray  # (n,) bool: a spring that stands stock-still where it should not
    suspect: np.ndarray  # (n,) bool: a chamber without whose pressure the springs would lie as they do
    window: Window
    command: Command  # in force as the readings were taken
    mean_m: np.ndarray  # (n,) mean lengths over the window
    at_rest: bool  # nothing has moved for a window; one after the last action, at the earliest
    settled: bool  # at rest with each spring on its reference, or its chamber at a limit
    saturated: np.ndarray  # (n,) bool: a chamber at its limit with its spring off the reference
    load: Load  # payload
    estimate_kg: float | None  # payload of this tick's window alone; None: none was estimated
    n_unweighed: int  # ticks since the payload was last estimated
    pose: np.ndarray  # (6,) [mm, deg] of the tip; NaN before the first lengths
    away: float  # distance of the pose from the sim-to-real network's training rows, over the limit

    @classmethod
    def none(cls, controller: Controller) -> Belief:
        """Return the belief before the first tick."""
        n, nan = controller.policy.spec.n_chambers, np.full(controller.policy.spec.n_chambers, np.nan)
        no, load = np.zeros(n, bool), Load(controller.policy.spec.mass.payload_kg)
        window, command = Window(*(np.empty((0, n)) for _ in Window._fields)), Command.none(n)
        return cls(
            nan,
            no,
            "",
            no,
            no,
            window,
            command,
            nan,
            False,
            False,
            no,
            load,
            None,
            0,
            np.full(6, np.nan),
            0.0,
        )

    @property
    def known(self) -> bool:
        """Whether each spring has been read once."""
        return not np.isnan(self.spring_m).any()


def believe(
    controller: Controller,
    last: Belief,
    command: Command,
    readings: np.ndarray | None,
    measured_kpa: np.ndarray | None = None,
) -> Belief:
    """Return the belief of a tick.

    Args:
        controller: the policy.
        last: belief of the last tick.
        command: in force.
        readings (n,): of the sensors, or None where none came in time.
        measured_kpa (n,) [kPa]: of the chambers; NaN, or None for all, where only those in force are known.
    """
    policy, config, most = controller.policy, controller.config, controller.window
    pressure_kpa, reference_m = command.pressure_kpa, command.reference_m
    no = np.zeros(len(pressure_kpa), bool)

    # Lengths
    spring_m, lost, why = read_lengths(policy.sensor, readings, last.spring_m)
    chamber_kpa = (
        pressure_kpa
        if measured_kpa is None
        else np.where(np.isfinite(measured_kpa), measured_kpa, pressure_kpa)
    )
    window = last.window.with_tick((spring_m, pressure_kpa, chamber_kpa), most)
    mean_m, full = window.spring_m.mean(axis=0), len(window.spring_m) == most
    known = not np.isnan(spring_m).any()

    # Rest
    at_rest = full and command.n_ticks >= most and bool(still(window.spring_m, config))
    settled, blocked, suspect = False, no, no
    if reference_m is not None and known:
        told = reference_m, pressure_kpa, policy.gains, policy.tolerance_m
        settled = at_rest and bool(on_reference(window.spring_m, *told))
        blocked = saturated(pressure_kpa, reference_m, mean_m, policy.gains, policy.tolerance_m)
        seen = pressure_kpa, reference_m, spring_m
        suspect = lost_chambers(policy.spring_model, policy.gains, *seen, policy.tolerance_m, config)
    stuck = stuck_springs(window.spring_m, window.pressure_kpa, config) if full else no

    # Payload, of windows that do not overlap
    load, estimate_kg, n_unweighed = last.load, None, last.n_unweighed + 1
    if at_rest and n_unweighed >= most and not (lost | stuck | suspect).any():
        load, estimate_kg = _weighed(policy, load, mean_m, window.chamber_kpa.mean(axis=0))
        n_unweighed = 0

    # Pose
    pose, away = pose_of(controller, spring_m, load)
    return Belief(
        spring_m,
        lost,
        why,
        stuck,
        suspect,
        window,
        command,
        mean_m,
        at_rest,
        settled,
        blocked,
        load,
        estimate_kg,
        n_unweighed,
        pose,
        away,
    )


def pose_of(controller: Controller, spring_m: np.ndarray, load: Load) -> tuple[np.ndarray, float]:
    """Return the tip pose of springs (n,) [m] with a payload.

    Returns:
        Pose (6,) [mm, deg], NaN where a length is; `s2r.extrapolation` of it, 0 without a network.
    """
    if np.isnan(spring_m).any():
        return np.full(6, np.nan), 0.0
    pose, away = controller.tip(spring_m, load.believed_kg)
    return pose, float(away)


def _weighed(policy: Policy, load: Load, mean_m: np.ndarray, mean_kpa: np.ndarray) -> tuple[Load, float]:
    """Return the payload averaged with the estimate of mean springs and pressures (n,) at rest, and this.

    An estimate that is no payload leaves the specified one.
    """
    most_kg = float(policy.load_estimator.load_scale_kg)
    estimate_kg = float(estimate_load(policy.load_estimator, mean_m, mean_kpa))
    if LOWEST * most_kg <= estimate_kg <= HIGHEST * most_kg:
        return averaged(load, estimate_kg, most_kg), estimate_kg
    return Load(policy.spec.mass.payload_kg), estimate_kg


def read_lengths(
    sensor: Sensor, readings: np.ndarray | None, last_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return spring lengths (n,) [m], the last ones where a reading is lost; which are (n,); and why."""
    if readings is None:
        return last_m, np.ones(len(last_m), bool), "no readings within the tick"
    reading = sensor.lengths(readings)
    lost = reading.fault != SensorFault.OK.value
    text = sensor.describe_faults(readings, reading.fault).replace("\n", "; ")
    return np.where(lost, last_m, reading.length_m), lost, text


def still(spring_m: Array, config: LoopConfig = LOOP) -> Array:
    """Return whether springs came to rest over a window (ticks, n) [m]: its halves have the same mean."""
    xp, half = array_namespace(spring_m), len(spring_m) // 2
    moved_m = xp.mean(spring_m[-half:], axis=0) - xp.mean(spring_m[:half], axis=0)  # (n,)
    return xp.all(xp.abs(moved_m) < config.still_m)


def on_reference(
    springs_m: Array, reference_m: Array, pressure_kpa: Array, gains: Gains, tolerance_m: float
) -> Array:
    """Return whether each spring is on its reference, in the mean of a window, or its chamber at a limit.

    Args:
        springs_m (ticks, n) [m]: lengths over the window.
        reference_m (n,) [m]: asked of the springs.
        pressure_kpa (n,) [kPa]: commanded.
        gains: with the limits.
        tolerance_m: greatest error of a spring that counts as on its reference.
    """
    xp = array_namespace(springs_m, reference_m, pressure_kpa)
    off_m = xp.abs(xp.mean(springs_m, axis=0) - reference_m)
    at_limit = (pressure_kpa <= gains.pressure_min_kpa) | (pressure_kpa >= gains.pressure_max_kpa)
    return xp.all((off_m < tolerance_m) | at_limit)


def stuck_springs(spring_m: np.ndarray, pressure_kpa: np.ndarray, config: LoopConfig = LOOP) -> np.ndarray:
    """Return which springs (n,) stand stock-still where they should not.

    Args:
        spring_m (ticks, n) [m]: lengths of the last ticks.
        pressure_kpa (ticks, n) [kPa]: pressures commanded in these ticks.
        config: thresholds.
    """
    suspects = stock_still(spring_m, config)
    return suspects & asked_to_move(spring_m, pressure_kpa, config) if suspects.any() else suspects


def stock_still(spring_m: Array, config: LoopConfig = LOOP) -> Array:
    """Return which springs (n,) did not move, nor show any noise, over a window (ticks, n) [m]."""
    return _range(spring_m) < config.stuck_range_m


def asked_to_move(spring_m: Array, pressure_kpa: Array, config: LoopConfig = LOOP) -> Array:
    """Return which springs (n,) should have moved: the chamber was driven or the section moved."""
    xp, moved_m = array_namespace(spring_m), _range(spring_m)
    section_m = xp.max(moved_m.reshape(-1, N_CHAMBERS_PER_SECTION), axis=1)[:, None]  # (n_sections, 1)
    near_m = (section_m + np.zeros(N_CHAMBERS_PER_SECTION)).reshape(-1)  # (n,)
    return (_range(pressure_kpa) > config.stuck_pressure_kpa) | (near_m > config.stuck_neighbour_m)


def _range(values: Array) -> Array:
    """Return the range (n,) of values (ticks, n)."""
    xp = array_namespace(values)
    return xp.max(values, axis=0) - xp.min(values, axis=0)


def lost_chambers(
    model: SpringModel,
    gains: Gains,
    pressure_kpa: np.ndarray,
    reference_m: np.ndarray,
    spring_m: np.ndarray,
    tolerance_m: float,
    config: LoopConfig = LOOP,
) -> np.ndarray:
    """Return which chambers (n,) of an arm at rest, or nearly so, have lost their pressure.

    A chamber at its limit with its spring off the reference is saturated, or it no longer holds pressure.
    Then the arm has the shape that it would have without that pressure: the springs' deviations from the
    model are, for the most part, a good share of what the pressure's absence makes of them.

    Args:
        model: lengths to expect at pressures.
        gains: with the limits.
        pressure_kpa (n,) [kPa]: commanded.
        reference_m (n,) [m]: asked of the springs.
        spring_m (n,) [m]: read.
        tolerance_m: greatest error of a spring that counts as on its reference.
        config: thresholds.
    """
    suspects = saturated(pressure_kpa, reference_m, spring_m, gains, tolerance_m)
    return suspects & as_without(model, pressure_kpa, spring_m, config) if suspects.any() else suspects


def as_without(model: SpringModel, pressure_kpa: Array, spring_m: Array, config: LoopConfig = LOOP) -> Array:
    """Return for which chambers (n,) the springs lie as they would without that chamber's pressure."""
    xp, own = array_namespace(pressure_kpa, spring_m), np.eye(len(pressure_kpa), dtype=bool)
    pressures_kpa = xp.concat([pressure_kpa[None], xp.where(own, 0.0, pressure_kpa)])  # (1 + n, n)
    springs_m = expected_springs(model, pressures_kpa)
    effect_m = springs_m[1:] - springs_m[0]  # (n chambers, n springs)
    deviation_m = spring_m - springs_m[0]  # (n,)
    share = effect_m @ deviation_m / xp.sum(effect_m**2, axis=1)  # (n,)
    left_m = deviation_m - share[:, None] * effect_m
    explained = 1.0 - xp.sum(left_m**2, axis=1) / xp.sum(deviation_m**2)
    own_m = xp.abs(share * xp.sum(xp.where(own, effect_m, 0.0), axis=1))
    enough = (share > config.lost_share) & (explained > config.explained_share)
    return enough & (own_m > config.lost_effect_m)
