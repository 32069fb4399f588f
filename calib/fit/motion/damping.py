"""Damping of chambers and backbone, fitted to the tip's motion after the pressures changed.

C MuJoCo is driven with the logged pressures along a stretch of the log, or with those that the calibrated
actuators make of the commands where no pressures were measured. Its tip is compared with the measured tip.
The first seconds do not count: the arm's motion at the beginning is unknown, and decays.

The damping of the springs and the axial damping of the backbone stay as specified. They act in parallel with
the chambers, which absorb their error. The bending damping of the backbone is fitted here only where
`calib.fit.motion.shape` does not show it: on rods, whose tips are some 3 mm off at rest, this fit was off by
half.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from calib.fit.blocks import held_out_blocks
from calib.fit.leastsquares import NOT_CONVERGED, Problem, fit
from calib.fit.motion.tracks import (
    clusters,
    dense_parts,
    driven_kpa,
    has_commands_alone,
)
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.fields import PerSection, scaled
from mjx_softarm.logs.rest import HOLD_KPA
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.mjcf import build_model, steps_per_period
from mjx_softarm.mechanics.workspace import settle_many
from mjx_softarm.spec import ArmSpec

SETTLING_S = 5.0  # start of a stretch that does not count
MIN_COUNTED_S = 2.0
MAX_TOTAL_S = 24.0  # length of all stretches together
CLUSTER_S = 1.0  # errors within this time are not independent
PRIOR = 1.0  # standard deviation of the logarithms: a factor of e
DIFFERENCE = 0.01  # change of a logarithm between two runs
SCALE_M, MIN_SCALE_M = 2e-3, 1e-4  # standard deviation of the tip: first guess, least value
KNOWN = 0.2  # relative half-width of an interval up to which a damping counts as known
MARGIN = 1.05  # ratio of errors from which the specification counts as better than the fit
MAX_RATIO = 2.0  # ratio of held-out to other errors from which there is a warning


class Stretch(NamedTuple):
    """Part of a log without gaps, resampled at the control rate."""

    pressure_kpa: np.ndarray  # (n, n_chambers), each row until the next
    tip_m: np.ndarray  # (n, 3)
    payload_kg: float


@dataclass(frozen=True, eq=False)
class DampingFit:
    """Calibrated damping and whether to trust it. Errors are RMS distances of simulated to measured tips."""

    spec: ArmSpec
    half_width_95: Mapping[str, PerSection]  # half-widths of the 95 % intervals of the two dampings
    in_sample_rms_mm: float  # seconds of the fit
    held_out_rms_mm: float  # held-out seconds
    held_out_before_rms_mm: float  # held-out seconds, with the specification of the start
    n_stretches: int
    time_s: float  # simulated time, the first seconds of each stretch included
    warnings: tuple[str, ...]  # reasons not to trust the fit, each with its remedy

    @property
    def is_better(self) -> bool:
        """Whether the fit is no worse on held-out seconds than the specification that it started from."""
        return self.held_out_rms_mm <= MARGIN * self.held_out_before_rms_mm


def fit_damping(
    stretches: Sequence[Stretch], spec: ArmSpec, seed: int = 0, bending_half_width: float | None = None
) -> DampingFit:
    """Fit the damping of chambers and backbone to the motion of an arm.

    Args:
        stretches: parts of logs from `find_stretches`, one or more.
        spec: arm, its chambers already calibrated.
        seed: seed that chooses the held-out seconds.
        bending_half_width: relative half-width of the backbone's damping, which is known and stays; None to
            fit it.

    Raises:
        InputError: the specified damping is zero.
    """
    both = spec.chambers.damping_ns_per_m, spec.backbone.bending_damping_nms_per_rad
    if not all(np.all(np.greater(damping, 0.0)) for damping in both):
        raise InputError(
            f"damping: got chambers.damping_ns_per_m {both[0]!r} and "
            f"backbone.bending_damping_nms_per_rad {both[1]!r}, "
            "expected both above 0"
        )
    # Fit to the seconds that are not held out.
    n_free = 2 if bending_half_width is None else 1
    n_clusters = len(_clusters(stretches, [s.tip_m for s in stretches], spec))
    held_out = held_out_blocks(n_clusters, block=2, seed=seed)
    problem = Problem(
        prior=np.full(n_free, PRIOR),
        group=np.zeros(3 * _rows(CLUSTER_S, spec), int),
        scale=np.array([SCALE_M]),
        min_scale=np.array([MIN_SCALE_M]),
    )

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        error, slope = _errors(stretches, spec, x)
        return error[~held_out], slope[~held_out]

    solution = fit(model, problem)
    # Judge the fit by the held-out seconds.
    before, after = (_errors(stretches, spec, x)[0] for x in (np.zeros(n_free), solution.x))
    calibrated = damped(spec, solution.x)
    widths = np.append(solution.half_width, [] if bending_half_width is None else bending_half_width)
    done = DampingFit(
        spec=calibrated,
        half_width_95={
            "damping_ns_per_m": scaled(calibrated.chambers.damping_ns_per_m, float(widths[0])),
            "bending_damping_nms_per_rad": scaled(
                calibrated.backbone.bending_damping_nms_per_rad, float(widths[1])
            ),
        },
        in_sample_rms_mm=_rms_mm(after[~held_out]),
        held_out_rms_mm=_rms_mm(after[held_out]),
        held_out_before_rms_mm=_rms_mm(before[held_out]),
        n_stretches=len(stretches),
        time_s=sum(len(s.tip_m) for s in stretches) / spec.control.rate_hz,
        warnings=(),
    )
    return dataclasses.replace(done, warnings=_warnings(done, widths, solution.converged))


def find_stretches(logs: Sequence[Log], spec: ArmSpec) -> list[Stretch]:
    """Return densely sampled parts of logs in which pressures change, resampled at the control rate.

    Pressures are held from row to row, positions interpolated. Stretches come in the order of the logs, from
    the end of a part that is too long, until they last `MAX_TOTAL_S` together: a recording begins with small
    motions.
    """
    stretches, left = [], _rows(MAX_TOTAL_S, spec)
    shortest = _rows(SETTLING_S + MIN_COUNTED_S, spec)
    for log in logs:
        if log.pressure_kpa is None or log.tip_m is None or len(log) < 2:
            continue
        payload = np.full(len(log), spec.mass.payload_kg) if log.payload_kg is None else log.payload_kg
        spring_m = log.lengths_m(spec.spring_sensor)
        # Cut the log at gaps, and where the payload changes.
        for rows, times_s, newest in dense_parts(log, 1.0 / spec.control.rate_hz, np.diff(payload) != 0):
            # Resample the part, if it is long enough and its pressures change after the first seconds.
            grid, newest, time_s = times_s[-left:], newest[-left:], log.time_s[rows]
            if left == 0 or len(grid) < shortest:
                continue
            pressure = log.pressure_kpa[newest]
            if has_commands_alone(log):
                next_row = np.minimum(newest + 1, rows[-1])  # has the command that was in force before it
                length_m = None if spring_m is None else spring_m[newest]
                pressure = driven_kpa(log.pressure_kpa[next_row], length_m, spec)
            if (np.ptp(pressure[_rows(SETTLING_S, spec) :], axis=0) <= HOLD_KPA).all():
                continue
            tip = np.stack([np.interp(grid, time_s, log.tip_m[rows, k]) for k in range(3)], axis=1)
            stretches.append(Stretch(pressure, tip, float(payload[rows[0]])))
            left -= len(grid)
    return stretches


def damped(spec: ArmSpec, x: np.ndarray) -> ArmSpec:
    """Return the arm with the damping of chambers and backbone times exp(x), (2,); (1,) of chambers alone."""
    chambers, bending = map(float, np.exp([*x, 0.0][:2]))
    backbone = spec.backbone.bending_damping_nms_per_rad
    return spec.replace(
        chambers={"damping_ns_per_m": scaled(spec.chambers.damping_ns_per_m, chambers)},
        backbone={"bending_damping_nms_per_rad": scaled(backbone, bending)},
    )


def simulate(stretch: Stretch, spec: ArmSpec) -> np.ndarray:
    """Return tip positions (n, 3) [m] of C MuJoCo under the pressures of a stretch, started at rest."""
    spec = spec.replace(mass={"payload_kg": stretch.payload_kg})
    model = build_model(spec)
    data = mujoco.MjData(model)
    data.qpos[:] = settle_many(spec, stretch.pressure_kpa[:1]).q[0]
    n_steps, tip = steps_per_period(1.0 / spec.control.rate_hz), np.empty_like(stretch.tip_m)
    for row, pressure in enumerate(stretch.pressure_kpa):
        mujoco.mj_kinematics(model, data)
        tip[row] = data.site("tip").xpos
        data.ctrl[:] = pressure
        mujoco.mj_step(model, data, n_steps)
    return tip


def _errors(stretches: Sequence[Stretch], spec: ArmSpec, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return simulated minus measured tip by clusters (n, m) [m], NaN-padded; Jacobian (n, m, len(x))."""
    # Differences of three runs: derivatives through thousands of MJX's steps would compile for minutes.
    arms = [damped(spec, x + d) for d in (np.zeros(len(x)), *(DIFFERENCE * np.eye(len(x))))]
    with ThreadPoolExecutor() as pool:  # MuJoCo steps without Python's lock
        runs = list(pool.map(lambda job: simulate(*job), [(s, arm) for arm in arms for s in stretches]))
    n = len(stretches)
    here, *ahead = (_clusters(stretches, runs[k * n : (k + 1) * n], spec) for k in range(len(arms)))
    return here, np.stack([(a - here) / DIFFERENCE for a in ahead], axis=-1)


def _clusters(stretches: Sequence[Stretch], tips: list[np.ndarray], spec: ArmSpec) -> np.ndarray:
    """Return errors of the rows that count, one second a row; the last of a stretch is NaN-padded."""
    size, skip = _rows(CLUSTER_S, spec), _rows(SETTLING_S, spec)
    errors = ((tip - stretch.tip_m)[skip:] for stretch, tip in zip(stretches, tips, strict=True))
    return np.concatenate([clusters(error, size).reshape(-1, size * 3) for error in errors])


def _rows(time_s: float, spec: ArmSpec) -> int:
    return max(round(time_s * spec.control.rate_hz), 1)


def _rms_mm(error: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(3.0 * np.nanmean(error**2)))


def _warnings(done: DampingFit, widths: np.ndarray, converged: bool) -> tuple[str, ...]:
    said = [] if converged else [NOT_CONVERGED]
    for name, width in zip(done.half_width_95, widths, strict=True):
        if width > KNOWN:
            said.append(f"{name} is known to {100 * width:.0f} % only: record more poses")
    if done.held_out_rms_mm > MAX_RATIO * done.in_sample_rms_mm:
        said.append(
            f"held-out error {done.held_out_rms_mm:.1f} mm is more than {MAX_RATIO:g} times the error of the "
            f"other seconds, {done.in_sample_rms_mm:.1f} mm: log a longer motion"
        )
    if not done.is_better:
        said.append("the specified damping is better on held-out seconds, so it stays: log a longer motion")
    return tuple(said)
