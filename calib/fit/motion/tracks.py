"""Parts of logs of the moving arm; tracks of pressures in them, and simulations of actuators along these."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from mjx_softarm import pneumatics
from mjx_softarm.control import chambers_of_springs
from mjx_softarm.logs.rest import HOLD_KPA
from mjx_softarm.logs.schema import Log
from mjx_softarm.pneumatics import Actuators
from mjx_softarm.spec import ArmSpec

MAX_STEP_S = 0.05  # largest time between rows of a part
MIN_TRACK_S = 5.0  # length of a track
MAX_TOTAL_S = 300.0  # length of all tracks together
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
        Rows (m,) of a part; regular times (k,) [s] within it; the newest row (k,) at each of them, as an
        index within the part.
    """
    last = np.diff(log.time_s) > MAX_STEP_S
    last = last if ends is None else last | ends
    for rows in np.split(np.arange(len(log)), np.flatnonzero(last) + 1):
        time_s = log.time_s[rows]
        grid = np.arange(time_s[0], time_s[-1], every_s)
        yield rows, grid, np.searchsorted(time_s, grid + 1e-6, side="right") - 1


def clusters(errors: np.ndarray, size: int) -> np.ndarray:
    """Cut errors (n, k) into clusters (m, size, k) of neighbouring rows; the last is NaN-padded."""
    padded = np.pad(errors, ((0, -len(errors) % size), (0, 0)), constant_values=np.nan)
    return padded.reshape(-1, size, errors.shape[1])


class Track(NamedTuple):
    """Part of a log without gaps, resampled at the control rate."""

    commanded_kpa: np.ndarray  # (n, c) commands in force until the next row
    pressure_kpa: np.ndarray  # (n, c) measured
    volume_m3: np.ndarray  # (n, c)


def find_tracks(logs: Sequence[Log], spec: ArmSpec) -> list[Track]:
    """Return densely sampled parts of logs with commanded and measured pressures in which commands change.

    Tracks come in the order of the logs, until they last `MAX_TOTAL_S` together. Volumes are those at the
    section's length where a log has no lengths.
    """
    found, left, period_s = [], round(MAX_TOTAL_S * spec.control.rate_hz), 1.0 / spec.control.rate_hz
    for log in logs:
        if log.commanded_kpa is None or log.pressure_kpa is None or len(log) < 2:
            continue
        volume_m3 = _volumes(log, spec)
        for rows, times_s, newest in dense_parts(log, period_s):
            grid, time_s = times_s[:left], log.time_s[rows]
            changes = (np.ptp(log.commanded_kpa[rows], axis=0) > HOLD_KPA).any()
            if len(grid) < MIN_TRACK_S * spec.control.rate_hz or not changes:
                continue
            # A row has the command that was in force before it
            next_row = rows[np.minimum(newest[:left] + 1, len(rows) - 1)]
            measured, volume = (
                np.stack([np.interp(grid, time_s, column) for column in values[rows].T], axis=1)
                for values in (log.pressure_kpa, volume_m3)
            )
            found.append(Track(log.commanded_kpa[next_row], measured, volume))
            left -= len(grid)
    return found


class Runs:
    """Simulations of tracks, many actuators at once.

    Errors are arrays (clusters, rows) [kPa]: a cluster is a second of a chamber, NaN-padded. The chambers of
    a second follow each other.
    """

    def __init__(self, tracks: Sequence[Track], period_s: float):
        self.tracks, self._period_s = tracks, period_s
        self.n_chambers = tracks[0].pressure_kpa.shape[1]
        self.rows = max(round(CLUSTER_S / period_s), 1)
        self.n_seconds = sum(-(-len(track.pressure_kpa) // self.rows) for track in tracks)

    def errors(self, actuators: Actuators) -> np.ndarray:
        """Return simulated less measured pressures (clusters, rows)."""
        return self.errors_of([actuators])[0]

    def errors_of(self, actuators: Sequence[Actuators]) -> list[np.ndarray]:
        """Return simulated less measured pressures (clusters, rows) of actuators of one kind."""
        delay_s = np.array([np.full(self.n_chambers, one.delay_s) for one in actuators])  # (b, c)
        offsets = [0.0 if one.rest_offset_kpa is None else one.rest_offset_kpa for one in actuators]
        offset_kpa = np.array([np.full(self.n_chambers, offset) for offset in offsets])
        together = _stacked(actuators)
        runs = [self._run(track, together, delay_s, offset_kpa) for track in self.tracks]
        return [
            self.clusters([run[:, b] - t.pressure_kpa for run, t in zip(runs, self.tracks, strict=True)])
            for b in range(len(actuators))
        ]

    def clusters(self, errors: Sequence[np.ndarray]) -> np.ndarray:
        """Cut errors (n, c) of the tracks into clusters."""
        seconds = np.concatenate([clusters(error, self.rows) for error in errors])
        return np.swapaxes(seconds, 1, 2).reshape(-1, self.rows)

    def rest_offset_kpa(self) -> np.ndarray:
        """Return the median of measured less commanded pressures (c,)."""
        return np.median(np.concatenate([t.pressure_kpa - t.commanded_kpa for t in self.tracks]), axis=0)

    def _run(
        self, track: Track, actuators: Actuators, delay_s: np.ndarray, offset_kpa: np.ndarray
    ) -> np.ndarray:
        """Return the pressures (n, b, c) of a track, at rest before it."""
        first_kpa = np.broadcast_to(track.pressure_kpa[0], delay_s.shape)
        command_kpa = _delayed(track.commanded_kpa, first_kpa - offset_kpa, delay_s / self._period_s)
        pressure_kpa = np.empty_like(command_kpa)
        gas_m3 = pneumatics.gas_at(first_kpa, track.volume_m3[0])
        for k, volume_m3 in enumerate(track.volume_m3):
            pressure_kpa[k] = pneumatics.pressure_of(gas_m3, volume_m3)
            gas_m3 = actuators.fill(gas_m3, volume_m3, command_kpa[k], self._period_s)
        return pressure_kpa


def _stacked(actuators: Sequence[Actuators]) -> Actuators:
    """Return actuators of one kind as one, with arrays (b, c) where a number differs between them."""
    values = {}
    for item in dataclasses.fields(actuators[0]):
        each = [getattr(one, item.name) for one in actuators]
        values[item.name] = each[0] if np.ndim(each[0]) == 0 else np.array(each)
    return dataclasses.replace(actuators[0], **values)


def _delayed(command_kpa: np.ndarray, before_kpa: np.ndarray, delay: np.ndarray) -> np.ndarray:
    """Return the mean commands (n, b, c) in each period after dead times.

    Args:
        command_kpa (n, c): command of each period.
        before_kpa (b, c): command before the first.
        delay (b, c): dead times, in periods.
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


def _volumes(log: Log, spec: ArmSpec) -> np.ndarray:
    """Return the volumes (n, c) [m^3] of the chambers from the lengths of their springs."""
    rest_m, chambers = spec.at_chambers(spec.geometry.section_length_m), spec.chambers
    area_m2, slope_m = (np.array(spec.per_chamber(x)) for x in (chambers.area_m2, chambers.area_slope_m))
    length_m = np.broadcast_to(rest_m, (len(log.time_s), spec.n_chambers))
    readings, spring_m = log.readings_of(spec.sensor), log.spring_m
    if spring_m is None and readings is not None:
        free_m = spec.at_springs(spec.geometry.section_length_m)  # of a spring without a believed reading
        spring_m = spec.spring_sensor.lengths(readings, free_m).length_m
    if spring_m is not None:
        length_m = spring_m @ chambers_of_springs(spec).T
    return np.asarray(pneumatics.volume_m3(length_m, area_m2, slope_m, rest_m))
