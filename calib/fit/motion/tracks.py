"""Parts of logs of the moving arm; tracks of pressures in them, and simulations of actuators along these.

Where a log has no measured pressures, the springs are the gauge: the calibrated arm at rest with these
lengths would need the pressures y. In motion these lag behind the true ones p, as damping holds the arm back.
Each mode of a section, its mean pressure and the differences between its chambers, has a time constant T of
its own:

    T y' = p - y.

The mean stretches the section. The differences bend it, against the weight below as well, which shortens T.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import helmert
from scipy.signal import lfilter

from mjx_softarm import pneumatics
from mjx_softarm.control import chambers_of_springs
from mjx_softarm.logs.rest import HOLD_KPA
from mjx_softarm.logs.schema import Log
from mjx_softarm.pneumatics import Actuators
from mjx_softarm.spec import ArmSpec

MAX_STEP_S = 0.05  # largest time between rows of a part
MIN_TRACK_S = 5.0  # length of a track
MAX_TOTAL_S = 150.0  # length of all tracks together
CLUSTER_S = 1.0  # errors within this time are not independent


def dense_parts(
    log: Log, every_s: float, ends: np.ndarray | None = None
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Cut a log at gaps of time, and find the rows that were in force at regular times.

    Args:
        log: rows in the order of time.
        every_s: time between the regular times.
        ends (n - 1,) bool: rows after which a part ends, too.

    Yields:
        Rows (m,) of a part; regular times (k,) [s] within it; the newest row (k,) of the log at each of them.
    """
    last = np.diff(log.time_s) > MAX_STEP_S
    last = last if ends is None else last | ends
    for rows in np.split(np.arange(len(log)), np.flatnonzero(last) + 1):
        time_s = log.time_s[rows]
        grid = np.arange(time_s[0], time_s[-1], every_s)
        yield rows, grid, rows[np.searchsorted(time_s, grid + 1e-6, side="right") - 1]


def has_commands_alone(log: Log) -> bool:
    """Return whether the pressures of a log are commands: most do not change at all from row to row."""
    return (
        log.commanded_kpa is None
        and log.pressure_kpa is not None
        and len(log) > 1
        and not np.median(np.abs(np.diff(log.pressure_kpa, axis=0)))
    )


def driven_kpa(commanded_kpa: np.ndarray, spring_m: np.ndarray | None, spec: ArmSpec) -> np.ndarray:
    """Return the pressures (n, c) [kPa] that an arm's actuators make of commands (n, c) of control periods.

    Spring lengths (n, n_springs) [m] give the volumes; None where they are not known.
    """
    actuators = spec.actuators.per_chamber(spec.n_chambers)
    track = Track(
        commanded_kpa,
        commanded_kpa + actuators.rest_offset_kpa,
        volumes_m3(spring_m, len(commanded_kpa), spec),
    )
    return Runs([track], 1.0 / spec.control.rate_hz).simulated(actuators)[0][:, 0]


def clusters(errors: np.ndarray, size: int) -> np.ndarray:
    """Cut errors (n, k) into clusters (m, size, k) of neighbouring rows; the last is NaN-padded."""
    padded = np.pad(errors, ((0, -len(errors) % size), (0, 0)), constant_values=np.nan)
    return padded.reshape(-1, size, errors.shape[1])


class Track(NamedTuple):
    """Part of a log without gaps, resampled at the control rate."""

    commanded_kpa: np.ndarray  # (n, c) commands in force until the next row
    pressure_kpa: np.ndarray  # (n, c) measured, or by the springs
    volume_m3: np.ndarray  # (n, c)


def find_tracks(
    logs: Sequence[Log], spec: ArmSpec, resting_kpa: Callable[[np.ndarray], np.ndarray] | None = None
) -> list[Track]:
    """Return densely sampled parts of logs in which commands change, with the pressures that followed.

    Tracks come in the order of the logs, until they last `MAX_TOTAL_S` together. Volumes are those at the
    section's length where a log has no lengths.

    Args:
        logs: of the arm.
        spec: arm, its sensors already calibrated.
        resting_kpa: pressures (n, c) of the arm at rest with spring lengths (n, n_springs) [m]; takes logs
            without measured pressures. None takes the logs with measured ones.
    """
    tracks, left, period_s = [], round(MAX_TOTAL_S * spec.control.rate_hz), 1.0 / spec.control.rate_hz
    for log in logs:
        # What was commanded, and what followed: measured pressures or springs
        spring_m: Any = log.lengths_m(spec.spring_sensor)
        commanded_kpa, followed = log.commanded_kpa, log.pressure_kpa
        if resting_kpa is not None:
            commanded_kpa, followed = (log.pressure_kpa if has_commands_alone(log) else None), spring_m
        if commanded_kpa is None or followed is None or len(log) < 2:
            continue
        volume_m3 = volumes_m3(spring_m, len(log), spec)
        for rows, times_s, newest in dense_parts(log, period_s):
            grid, time_s = times_s[:left], log.time_s[rows]
            changes = (np.ptp(commanded_kpa[rows], axis=0) > HOLD_KPA).any()
            if len(grid) < MIN_TRACK_S * spec.control.rate_hz or not changes:
                continue
            # A row has the command that was in force before it
            next_row = np.minimum(newest[:left] + 1, rows[-1])
            on_grid, volume = (
                np.stack([_interpolated(grid, time_s, column) for column in values[rows].T], axis=1)
                for values in (followed, volume_m3)
            )
            pressure_kpa = on_grid if resting_kpa is None else resting_kpa(on_grid)
            tracks.append(Track(commanded_kpa[next_row], pressure_kpa, volume))
            left -= len(grid)
    return tracks


def _interpolated(grid: np.ndarray, time_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (n,) at regular times (k,), over gaps where they are NaN."""
    known = np.isfinite(values)
    return np.interp(grid, time_s[known], values[known]) if known.any() else np.full(len(grid), np.nan)


class Runs:
    """Simulations of tracks, many actuators at once.

    Errors are arrays (..., clusters, rows) [kPa]: a cluster is a second of a mode of the pressures,
    NaN-padded. The modes of a second follow each other.

    Args:
        tracks: what to follow.
        period_s: control period.
        n_sections: of tracks by the springs, whose modes are those of sections; None for measured pressures,
            where each chamber is a mode.
    """

    def __init__(self, tracks: Sequence[Track], period_s: float, n_sections: int | None = None):
        self.tracks, self._period_s = tracks, period_s
        self.n_chambers = tracks[0].pressure_kpa.shape[1]
        self.rows = max(round(CLUSTER_S / period_s), 1)
        self.n_seconds = sum(-(-len(track.pressure_kpa) // self.rows) for track in tracks)
        modes = np.eye(self.n_chambers)
        if n_sections is not None:
            modes = np.kron(np.eye(n_sections), helmert(self.n_chambers // n_sections, full=True))
        self.modes = modes  # (modes, c), orthonormal; the mean of a section comes first

    def errors(self, kpa: Sequence[np.ndarray], lag_s: np.ndarray) -> np.ndarray:
        """Return errors (b, clusters, rows) of pressures (n, b, c) of each track, with lags (modes,) [s]."""
        followed = self.followed(kpa, lag_s)
        measured = (track.pressure_kpa @ self.modes.T for track in self.tracks)
        return self.clusters([run - y[:, None] for run, y in zip(followed, measured, strict=True)])

    def followed(self, kpa: Sequence[np.ndarray], lag_s: np.ndarray) -> list[np.ndarray]:
        """Return the modes (n, b, modes) of pressures (n, b, c), behind these by lags (modes,) [s]."""
        runs = [run @ self.modes.T for run in kpa]
        for k in np.flatnonzero(lag_s):
            kept = np.exp(-self._period_s / lag_s[k])
            for run in runs:
                start = run[:1, :, k]
                run[..., k], _ = lfilter([0.0, 1.0 - kept], [1.0, -kept], run[..., k], axis=0, zi=start)
        return runs

    def simulated(self, actuators: Actuators) -> list[np.ndarray]:
        """Return the pressures (n, b, c) [kPa] of each track, at rest before it.

        Args:
            actuators: b actuators with numbers (b, c) or (b, 1), or one with numbers (c,) or ().
        """
        shape = np.broadcast_shapes((1, self.n_chambers), *map(np.shape, vars(actuators).values()))
        delay = np.broadcast_to(actuators.delay_s, shape) / self._period_s
        runs = []
        for track in self.tracks:
            first_kpa = np.broadcast_to(track.pressure_kpa[0], shape)
            command_kpa = _delayed(track.commanded_kpa, first_kpa - actuators.rest_offset_kpa, delay)
            pressure_kpa = np.empty_like(command_kpa)
            felt_m3 = actuators.felt(track.volume_m3[:, None])  # (n, b or 1, c)
            gas_m3 = pneumatics.gas_at(first_kpa, felt_m3[0])
            for k, volume_m3 in enumerate(felt_m3):
                pressure_kpa[k] = pneumatics.pressure_of(gas_m3, volume_m3)
                gas_m3 = actuators.fill(gas_m3, volume_m3, command_kpa[k], self._period_s)
            runs.append(pressure_kpa)
        return runs

    def clusters(self, errors: Sequence[np.ndarray]) -> np.ndarray:
        """Cut errors (n, b, modes) of the tracks into clusters (b, clusters, rows)."""
        each = [clusters(error.reshape(len(error), -1), self.rows) for error in errors]
        seconds = np.concatenate(each)  # (s, rows, b modes)
        seconds = seconds.reshape(*seconds.shape[:2], -1, self.n_chambers)
        return np.transpose(seconds, (2, 0, 3, 1)).reshape(seconds.shape[2], -1, self.rows)


def _delayed(command_kpa: np.ndarray, before_kpa: np.ndarray, delay: np.ndarray) -> np.ndarray:
    """Return the mean of commands (n, c) in each period (n, b, c) after dead times (b, c) [periods].

    Commands before the first are `before_kpa` (b, c).
    """
    out = np.empty((len(command_kpa), *delay.shape))
    whole, part = np.divmod(delay, 1.0)
    row = np.arange(len(command_kpa))
    for b, k in np.ndindex(*delay.shape):
        now, then = (
            np.where(late < 0, before_kpa[b, k], command_kpa[np.maximum(late, 0), k])
            for late in (row - int(whole[b, k]), row - int(whole[b, k]) - 1)
        )
        out[:, b, k] = now + part[b, k] * (then - now)
    return out


def volumes_m3(spring_m: np.ndarray | None, n: int, spec: ArmSpec) -> np.ndarray:
    """Return the volumes (n, c) [m^3] of the chambers from the lengths of their springs."""
    rest_m, chambers = spec.at_chambers(spec.geometry.section_length_m), spec.chambers
    area_m2, slope_m = (np.array(spec.per_chamber(x)) for x in (chambers.area_m2, chambers.area_slope_m))
    length_m = np.broadcast_to(rest_m, (n, spec.n_chambers))
    if spring_m is not None:
        free_m = spec.at_springs(spec.geometry.section_length_m)  # of a spring without a believed reading
        length_m = np.where(np.isfinite(spring_m), spring_m, free_m) @ chambers_of_springs(spec).T
    return np.asarray(pneumatics.volume_m3(length_m, area_m2, slope_m, rest_m))
