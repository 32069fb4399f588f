"""Accuracy of calibration, on a planted arm whose numbers are known and on public logs of real soft arms.

Errors are on contiguous blocks of rows that took no part in the fit.

Source: ASU-RISE-Lab/4-chamber-softarm-control (commit 6df7ec9d), StanfordASL/trunk-stack (commit 8b4b9234).
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calib import demo
from calib.fit.blocks import held_out_blocks
from calib.fit.chambers import fit_chambers
from calib.fit.leastsquares import rms_of
from calib.fit.motion.actuators import MEASURED, fit_regulator
from calib.fit.motion.tracks import Runs, Track
from calib.fit.s2r import fit_network
from calib.fit.springs import fit_line, fit_springs
from calib.read.logs import read_log
from calib.read.measurements import measure as measurements_of
from mjx_softarm import ArmSpec
from mjx_softarm._support import cli
from mjx_softarm.logs import checks
from mjx_softarm.logs.schema import UNITS
from mjx_softarm.sensing.s2r import correction

PSI = UNITS["pressure"]["psi"]  # [kPa]
ASU_PERIOD_S = 0.02
ASU_LOGS = {name: f"asu_softarm/{name}_data_collect_1.txt" for name in ("apr5", "apr4")}
TRUNK_LOG = "asl_trunk/observations_controlled_{}.csv"
STILL_M, STILL_S = 2e-3, 0.5  # the wires lag motion capture by a tenth of a second
SEEDS = (0, 1, 2)
N_NETWORKS = 5  # networks whose mean is judged, so that no one seed decides
WIRE_M_PER_V = 1.0 / 5.0  # draw-wire encoders: 5 V at 1 m, up to an offset that differs from day to day


def measure(data: cli.MaybePath = None) -> dict[str, Any]:
    """How exact is calibration, on a planted arm and, with --data, on logs of real arms?

    Args:
        data: folder with `asl_trunk` and `asu_softarm`; None: the planted arm alone
    """
    return {"planted arm": planted_arm(), **(real_logs(data) if data else {})}


def planted_arm() -> dict[str, float]:
    """Return errors, tips in mm, on `python -m calib demo`, whose geometry differs from the simulator's."""
    spec = ArmSpec.default()
    planted = demo.planted_arm(spec, seed=0)
    with tempfile.TemporaryDirectory() as folder:
        files = demo.write_demo(Path(folder), spec, seed=0)
        springs, poses = (read_log(file)[0] for file in files[:2])
    assert springs.readings is not None and springs.spring_m is not None  # as the demo writes them
    lines = fit_springs(springs.readings, springs.spring_m, spec.spring_sensor)
    sensor = {"beta": tuple(lines.slope.tolist()), "delta_m": tuple(lines.offset.tolist())}
    fit = fit_chambers(measurements_of([poses], spec), spec.replace(sensor=sensor))
    fitted, true = fit.spec.chambers, planted.chambers
    return {
        "beta, largest error [%]": _worst(lines.slope, planted.sensor.beta),
        "stiffness, largest error [%]": _worst(fitted.stiffness_n_per_m, true.stiffness_n_per_m),
        "area, largest error [%]": _worst(fitted.area_m2, true.area_m2),
        "tip at held-out poses, before": fit.held_out_before.translation_mean_mm,
        "tip at held-out poses, calibrated": fit.held_out.translation_mean_mm,
    }


def _worst(fitted: Any, true: Any) -> float:
    return 100 * float(np.max(np.abs(np.array(fitted) / np.array(true) - 1.0)))


def real_logs(data: Path) -> dict[str, Any]:
    """Return errors of calibrated lines, the sim-to-real network and regulators on logs of real arms."""
    day, other_day = (read_trunk(data / TRUNK_LOG.format(number)) for number in (1, 11))
    trunk = []
    for seed in SEEDS:
        out = held_out_blocks(len(day.fresh), seed=seed)
        trunk.append({"held out": f"a fifth of the blocks, seed {seed}", **trunk_errors([day], out)})
    out = np.repeat([False, True], [len(day.fresh), len(other_day.fresh)])
    trunk.append({"held out": "another day", **trunk_errors([day, other_day], out)})
    return {
        "draw wires to section length at rest, RMS": {name: wires_error(data, name) for name in ASU_LOGS},
        "trunk, 3D RMSE": trunk,
        "pressures of another day, RMS [psi]": regulators_errors(data),
    }


def regulators_errors(data: Path) -> dict[str, float]:
    """Return errors [psi] of pressures by the commands of one day, by regulators fitted to the other day.

    Volumes are taken as constant; a prediction sees the first measured pressures, then commands alone.
    """
    tracks = {name: asu_track(data / path) for name, path in ASU_LOGS.items()}
    days = {name: Runs([track], ASU_PERIOD_S) for name, track in tracks.items()}
    found = {}
    for fitted, asked in (tuple(ASU_LOGS), tuple(ASU_LOGS)[::-1]):
        every = np.ones(days[fitted].n_seconds * days[fitted].n_chambers, bool)
        regulator, lag_s, _ = fit_regulator(days[fitted], every, MEASURED, n_sections=2)
        error = days[asked].errors(days[asked].simulated(regulator), lag_s)
        found[f"of {asked}, fitted to {fitted}"] = rms_of(error) / PSI
        off_kpa = tracks[asked].commanded_kpa - tracks[asked].pressure_kpa
        found[f"of {asked}, the commands"] = rms_of(off_kpa) / PSI
    return found


def asu_track(path: Path) -> Track:
    """Return commands and pressures of a log of ASU RISE at a steady rate; a command holds until the next."""
    log = read_asu(path)
    grid = np.arange(log.time_s[0], log.time_s[-1], ASU_PERIOD_S)
    held = np.searchsorted(log.time_s, grid, side="right") - 1
    followed = np.stack([np.interp(grid, log.time_s, column) for column in log.pressure_kpa.T], axis=1)
    return Track(log.commanded_kpa[held], followed, np.ones_like(followed))


def wires_error(data: Path, name: str) -> float:
    """Return the error [mm] from section 1's draw wires to its length, on fresh rows at rest."""
    log = read_asu(data / ASU_LOGS[name])
    rows = log.fresh & still_rows(log.time_s, log.wire_m) & still_rows(log.time_s, log.section_m)
    return 1e3 * float(fit_line(log.wire_m[rows, None], log.section_m[rows, None]).held_out_rms[0])


def still_rows(time_s: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the rows (n,) around which x (n,) [m] moves by less than `STILL_M` within `STILL_S`.

    Two instruments that are not triggered together differ by speed times delay while the arm moves.
    """
    before, after = (np.interp(time_s + shift, time_s, x) for shift in (-STILL_S, STILL_S))
    return (np.abs(x - before) < STILL_M) & (np.abs(after - x) < STILL_M)


def trunk_errors(logs: Sequence[TrunkLog], held_out: np.ndarray) -> dict[str, float]:
    """Return tip errors [mm] on the held-out rows (n,) of all logs, of fits to the others; fresh rows count.

    Motor angles replace springs, and a polynomial the simulator.
    """
    x = np.concatenate([motor_angles(log.motor_deg) for log in logs])
    tip_mm = 1e3 * np.concatenate([log.tip_m for log in logs])
    fresh = np.concatenate([log.fresh for log in logs])
    train, test = fresh & ~held_out, fresh & held_out
    linear, cubic = (polynomial(x, tip_mm, train, degree) for degree in (1, 3))
    fits = [fit_network(x[train], (tip_mm - linear)[train], seed) for seed in range(N_NETWORKS)]
    network = linear + np.mean([correction(network, x) for network, _ in fits], axis=0)
    predictions = {"linear": linear, "cubic": cubic, "network": network}
    return {
        name: float(np.sqrt(np.mean(np.sum((predicted - tip_mm)[test] ** 2, axis=1))))
        for name, predicted in predictions.items()
    }


def motor_angles(measured_deg: np.ndarray) -> np.ndarray:
    """Return angles (n, 6) [deg] at the time of each row, from this row and those before.

    The motors are read about every 5 rows and their angles repeated in between, while the tip moves up to
    2.5 mm a row. So the last two readings are extrapolated by a straight line, taken as one row late.
    """
    row = np.arange(len(measured_deg))
    read = np.flatnonzero(np.r_[True, (np.diff(measured_deg, axis=0) != 0.0).any(axis=1)])
    last = np.searchsorted(read, row, side="right") - 1
    now, before = read[last], read[np.maximum(last - 1, 0)]
    rate = (measured_deg[now] - measured_deg[before]) / np.maximum(now - before, 1)[:, None]
    return measured_deg[now] + rate * (row - now - 1)[:, None]


def polynomial(x: np.ndarray, y: np.ndarray, train: np.ndarray, degree: int) -> np.ndarray:
    """Fit a polynomial in standardised inputs x (n, k) to rows `train` (n,) of y (n, m); predict all rows."""
    z = (x - x[train].mean(axis=0)) / x[train].std(axis=0)
    powers = [
        list(chosen)
        for d in range(degree + 1)
        for chosen in itertools.combinations_with_replacement(range(x.shape[1]), d)
    ]
    terms = np.stack([z[:, chosen].prod(axis=1) for chosen in powers], axis=1)
    return terms @ np.linalg.lstsq(terms[train], y[train], rcond=None)[0]


class AsuLog(NamedTuple):
    """The two-section pneumatic arm of ASU RISE."""

    time_s: np.ndarray  # (n,)
    commanded_kpa: np.ndarray  # (n, 6) of both sections
    pressure_kpa: np.ndarray  # (n, 6) measured
    wire_m: np.ndarray  # (n,) mean of the first section's two draw wires, from the base
    section_m: np.ndarray  # (n,) from the first section's base to its end
    fresh: np.ndarray  # (n,) whether every body has moved since the row before


class TrunkLog(NamedTuple):
    """Log of the three-segment tendon-driven trunk of Stanford ASL."""

    motor_deg: np.ndarray  # (n, 6) measured
    tip_m: np.ndarray  # (n, 3) y up
    fresh: np.ndarray  # (n,) whether the tip has moved since the row before


def read_asu(path: Path) -> AsuLog:
    """Read one `*_data_collect_*.txt`, without a header.

    Its 38 columns are the time, pressures [psi] of section 1, desired and measured, then of section 2, the
    four draw wires [V], and for base, middle and tip the position and the quaternion, scalar last.
    """
    values = np.loadtxt(path, delimiter=",")
    base, middle, tip = np.split(values[:, 17:], 3, axis=1)
    section_m = np.linalg.norm((middle - base)[:, :3], axis=1)
    stale = [checks.stale_rows(body) for body in (base, middle, tip)]
    kpa = PSI * values[:, 1:13].reshape(-1, 2, 2, 3)  # section, desired or measured, chamber
    return AsuLog(
        time_s=values[:, 0],
        commanded_kpa=kpa[:, :, 0].reshape(-1, 6),
        pressure_kpa=kpa[:, :, 1].reshape(-1, 6),
        wire_m=WIRE_M_PER_V * values[:, 13:15].mean(axis=1),
        section_m=section_m,
        fresh=~np.any(stale, axis=0),
    )


def read_trunk(path: Path) -> TrunkLog:
    """Read one `observations_controlled_*.csv`."""
    table = np.genfromtxt(path, delimiter=",", names=True)
    tip_m = np.stack([table[name] for name in ("x3", "y3", "z3")], axis=1)
    motor_deg = np.stack([table[f"phi{k}"] for k in range(1, 7)], axis=1)
    return TrunkLog(motor_deg, tip_m, ~checks.stale_rows(tip_m))
