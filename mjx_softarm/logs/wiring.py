"""Check of the wiring by a log: does each chamber move the springs beside it? NumPy only.

Where lengths were measured, too: does each spring's reading follow its own length?

A line through rows of random poses gives the change of each spring with each pressure. It should be a stretch
of the chamber's section and a bend away from the chamber. A chamber whose changes are more like those of
another one has a valve, or springs have sensors, of another number.
"""

from __future__ import annotations

import numpy as np

from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.body import chamber_directions, spring_directions
from mjx_softarm.spec import ArmSpec

# All by hand. On four kinds of arms, twins and rods with lags of up to 0.8 s among them, changes by chambers
# are like those expected by 0.71 to 0.98, and like those of another chamber by 0.3 at most.
ROWS_PER_CHAMBER = 20  # fewer rows show nothing
LEAST_PRESSURE = 0.05  # standard deviation of a pressure that counts as changing, in its range
LEAST_SPREAD = 0.05  # least eigenvalue of the pressures' correlations: in a way of a policy they go together
LEAST_SHARE = 0.3  # share of a spring's variance below which it follows no pressure
LEAST_CHANGE = 0.1  # change of the springs by a chamber, over the largest, below which it moves none
LEAST_M = 1e-5  # standard deviation of a spring that changes
MARGIN = 0.3  # by which the changes have to be more like those of another chamber
STRETCH = 0.3  # stretch of a section over its bend, at the springs
RULER_ROWS = 20  # fewer rows with a measured length show nothing
FOLLOWS, STRAYS = 0.9, 0.5  # correlations of a length with readings: of its spring, and not of its spring


def wiring_faults(log: Log, spec: ArmSpec) -> list[str]:
    """Return what a log says against the wiring: "got X, expected Y", empty if it says nothing."""
    if log.readings is None:
        return []
    spring_m = spec.spring_sensor.lengths(log.readings, np.nan).length_m
    return [*_exchanged_lengths(log.spring_m, spring_m), *_exchanged_chambers(log, spring_m, spec)]


def _exchanged_lengths(ruler_m: np.ndarray | None, spring_m: np.ndarray) -> list[str]:
    """Compare measured lengths (n, n_springs), if there are any, with those by the readings."""
    faults = []
    for k, length_m in enumerate([] if ruler_m is None else ruler_m.T):
        rows = np.isfinite(length_m) & np.isfinite(spring_m).all(axis=1)
        table = np.column_stack([length_m, spring_m])[rows]
        if len(table) < RULER_ROWS or table.std(axis=0).min() < LEAST_M:
            continue
        alike = np.corrcoef(table.T)[0, 1:]
        best = int(alike.argmax())
        if alike[k] < STRAYS and alike[best] > FOLLOWS:
            expected = "expected its own: columns or sensors have other numbers"
            faults.append(f"got lengths of spring{k} that follow the readings of spring{best}, {expected}")
    return faults


def _exchanged_chambers(log: Log, spring_m: np.ndarray, spec: ArmSpec) -> list[str]:
    """Compare the springs' lengths (n, n_springs) with the pressures."""
    # Rows with commands that change from chamber to chamber
    kpa = log.pressure_kpa if log.commanded_kpa is None else log.commanded_kpa
    if kpa is None:
        return []
    known = np.isfinite(spring_m).all(axis=1) & np.isfinite(kpa).all(axis=1)
    kpa, spring_m = kpa[known], spring_m[known]
    n, c = kpa.shape
    least_kpa = LEAST_PRESSURE * (spec.chambers.pressure_max_kpa - spec.chambers.pressure_min_kpa)
    if n < ROWS_PER_CHAMBER * c or kpa.std(axis=0).min() < least_kpa:
        return []
    if np.linalg.eigvalsh(np.corrcoef(kpa.T)).min() < LEAST_SPREAD:
        return []

    # Changes of the springs with the pressures, and the springs that follow none
    off_kpa, off_m = kpa - kpa.mean(axis=0), spring_m - spring_m.mean(axis=0)
    change = np.linalg.lstsq(off_kpa, off_m, rcond=None)[0]  # (c, n_springs) [m/kPa]
    left = np.var(off_m - off_kpa @ change, axis=0) / np.maximum(np.var(off_m, axis=0), LEAST_M**2)
    dead = (left > 1.0 - LEAST_SHARE) | (np.std(off_m, axis=0) < LEAST_M)
    if dead.all():
        return ["got springs that do not follow the pressures, expected each to: no air, or no valve opens"]
    faults = [
        f"got spring{k} that follows no pressure, expected it to: check its sensor and the valve beside it"
        for k in np.flatnonzero(dead)
    ]

    # Changes by each chamber beside those to expect of all chambers
    size = np.maximum(np.linalg.norm(change, axis=1), 1e-12)
    still = size < LEAST_CHANGE * size.max()
    faults += [
        f"got chamber{k} that moves no spring, expected it to: no air, or a valve that does not open"
        for k in np.flatnonzero(still)
    ]
    expected = _expected(spec)
    alike = (change / size[:, None]) @ (expected / np.linalg.norm(expected, axis=1)[:, None]).T
    best = alike.argmax(axis=1)
    other = ~still & (alike.max(axis=1) > np.diagonal(alike) + MARGIN)
    return faults + [
        f"got chamber{k} that moves the springs beside chamber{best[k]}, expected those beside it: "
        "valves or sensors have other numbers"
        for k in np.flatnonzero(other)
    ]


def _expected(spec: ArmSpec) -> np.ndarray:
    """Return the changes (n_chambers, n_springs) of springs by chambers, without a unit."""
    alike = STRETCH + chamber_directions(spec) @ spring_directions(spec).swapaxes(1, 2)  # of each section
    apart = np.eye(spec.structure.n_sections)
    return np.einsum("sck,st->sctk", alike, apart).reshape(spec.n_chambers, spec.n_springs)
