"""Accuracy of calibration, on a planted arm whose numbers are known and on public logs of real soft arms.

Errors are on contiguous blocks of rows that took no part in the fit. `asl_trunk` is a trunk of three segments
and six motors (StanfordASL/trunk-stack), `asu_softarm` a pneumatic arm of two sections with draw wires
(ASU-RISE-Lab/4-chamber-softarm-control). All rows are kept; `fresh` marks those with renewed motion capture.

Source: ASU-RISE-Lab/4-chamber-softarm-control (commit 6df7ec9d), StanfordASL/trunk-stack (commit 8b4b9234).
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calib import demo
from calib.fit.blocks import held_out_blocks
from calib.fit.chambers import fit_chambers
from calib.fit.lines import fit_line
from calib.fit.network import fit_network
from calib.fit.sensors import fit_springs
from calib.read.logs import read_log
from calib.read.measurements import measure as measurements_of
from mjx_softarm import ArmSpec
from mjx_softarm._support import cli
from mjx_softarm.logs import checks
from mjx_softarm.logs.checks import Finding, LogError
from mjx_softarm.logs.schema import UNITS
from mjx_softarm.logs.tables import read_table
from mjx_softarm.sensing.s2r import correction

ASU_LOGS = {name: f"asu_softarm/{name}_data_collect_1.txt" for name in ("apr5", "apr4")}
TRUNK_LOG = "asl_trunk/observations_controlled_{}.csv"
STILL_M, STILL_S = 2e-3, 0.5  # the wires lag motion capture by a tenth of a second
SEEDS = (0, 1, 2)
N_NETWORKS = 5  # networks whose mean is judged, so that no one seed decides
N_BODIES = 3
WIRE_M_PER_V = 1.0 / 5.0  # draw-wire encoders: 5 V at 1 m, up to an offset that differs from day to day


def measure(data: cli.MaybePath = None) -> dict[str, Any]:
    """How exact is calibration, on a planted arm and, with --data, on logs of real arms?

    Args:
        data: folder with `asl_trunk` and `asu_softarm`; None: the planted arm alone

    Raises:
        LogError: a log is missing, or cannot be read.
    """
    return {"planted arm": planted_arm(), **(real_logs(data) if data else {})}


def planted_arm() -> dict[str, float]:
    """Return errors of the numbers of `python -m calib demo`, whose geometry differs from the simulator's.

    Tips are in mm.
    """
    spec = ArmSpec.default()
    planted = demo.planted_arm(spec, seed=0)
    with tempfile.TemporaryDirectory() as folder:
        files = demo.write_demo(Path(folder), spec, seed=0)
        springs, poses = (read_log(file)[0] for file in files[:2])
    assert springs.readings is not None and springs.spring_m is not None  # as the demo writes them
    lines = fit_springs(springs.readings, springs.spring_m, spec.spring_sensor)
    sensor = {"beta": tuple(map(float, lines.beta)), "delta_m": tuple(map(float, lines.delta_m))}
    fit = fit_chambers(measurements_of([poses], spec), spec.replace(sensor=sensor))
    return {
        "beta, largest error [%]": 100 * _worst(lines.beta, planted.sensor.beta),
        "stiffness, largest error [%]": 100
        * _worst(fit.spec.chambers.stiffness_n_per_m, planted.chambers.stiffness_n_per_m),
        "area, largest error [%]": 100 * _worst(fit.spec.chambers.area_m2, planted.chambers.area_m2),
        "tip at held-out poses, before": fit.held_out_before.translation_mean_mm,
        "tip at held-out poses, calibrated": fit.held_out.translation_mean_mm,
    }


def _worst(fitted: Any, true: Any) -> float:
    return float(np.max(np.abs(np.array(fitted) / np.array(true) - 1.0)))


def real_logs(data: Path) -> dict[str, Any]:
    """Return errors [mm] of calibrated lines and of the sim-to-real network on logs of real arms."""
    return {
        "draw wires to section length, RMS": {name: wires(data, name) for name in ASU_LOGS},
        "trunk, 3D RMSE": {
            **{f"_1, seed {seed}": trunk_errors(data, "1", _blocks(seed)) for seed in SEEDS},
            "_11, last fifth": trunk_errors(data, "11", lambda n: np.arange(n) >= 0.8 * n),
            "_1 asked for _11": trunk_across(data, "1", "11"),
        },
    }


def wires(data: Path, name: str) -> dict[str, float]:
    """Return errors from section 1's draw wires to its length, on fresh rows and on those at rest."""
    log = read_asu(data / ASU_LOGS[name])
    wire_m, length_m = log.wire_m[:, :2].mean(axis=1), log.section_m
    still = still_rows(log.time_s, wire_m) & still_rows(log.time_s, length_m)
    rows = {"fresh rows": log.fresh, "fresh rows at rest": log.fresh & still}
    fits = {kind: fit_line(wire_m[chosen, None], length_m[chosen, None]) for kind, chosen in rows.items()}
    return {kind: 1e3 * float(fit.held_out_rms[0]) for kind, fit in fits.items()}


def still_rows(time_s: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Mask (n,) of the rows around which x (n,) [m] moves by less than `STILL_M` within `STILL_S`.

    Two instruments that are not triggered together differ by speed times delay while the arm moves. A fit's
    residuals have no say in it.
    """
    before, after = (np.interp(time_s + shift, time_s, x) for shift in (-STILL_S, STILL_S))
    return (np.abs(x - before) < STILL_M) & (np.abs(after - x) < STILL_M)


def _blocks(seed: int) -> Callable[[int], np.ndarray]:
    return lambda n: held_out_blocks(n, seed=seed)  # a fifth of the blocks of 100 rows


def trunk_errors(
    data: Path, log: str, held_out: Callable[[int], np.ndarray], history: bool = True
) -> dict[str, float]:
    """Return tip errors on fresh held-out rows; motor angles replace springs, a line the simulator.

    The log is "1" or "11"; with `history`, its angles are extrapolated, see `motor_angles`.
    """
    x, tip_mm, fresh = _trunk(data, log, history)
    out = held_out(len(x))
    return _trunk_errors(x, tip_mm, ~out & fresh, out & fresh)


def trunk_across(data: Path, log: str, asked: str) -> dict[str, float]:
    """Return tip errors on the fresh rows of a log, of fits to another log."""
    parts = [_trunk(data, name, True) for name in (log, asked)]
    x, tip_mm, fresh = (np.concatenate(column) for column in zip(*parts, strict=True))
    train = np.arange(len(x)) < len(parts[0][0])
    return _trunk_errors(x, tip_mm, train & fresh, ~train & fresh)


def _trunk(data: Path, log: str, history: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return motor angles (n, 6) [deg], tips (n, 3) [mm], and whether they are fresh (n,)."""
    trunk = read_trunk(data / TRUNK_LOG.format(log))
    x = motor_angles(trunk.motor_deg) if history else trunk.motor_deg
    return x, 1e3 * trunk.position_m[:, -1], trunk.fresh


def _trunk_errors(x: np.ndarray, tip_mm: np.ndarray, train: np.ndarray, test: np.ndarray) -> dict[str, float]:
    """Return errors on rows `test` (n,) of polynomials and the mean network, fitted to rows `train` (n,)."""
    linear, quadratic, cubic = (polynomial(x, tip_mm, train, degree) for degree in (1, 2, 3))
    fits = [fit_network(x[train], (tip_mm - linear)[train], seed) for seed in range(N_NETWORKS)]
    network = linear + np.mean([correction(fit.network, x) for fit in fits], axis=0)
    predictions = {"linear": linear, "quadratic": quadratic, "cubic": cubic, "network": network}
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
    """Fit a polynomial in standardised inputs to some rows; return predictions (n, n_out) for all rows.

    Args:
        x (n, n_in): inputs.
        y (n, n_out): outputs.
        train (n,) bool: rows of the fit.
        degree: of the polynomial.
    """
    z = (x - x[train].mean(axis=0)) / x[train].std(axis=0)
    powers = [
        list(chosen)
        for d in range(degree + 1)
        for chosen in itertools.combinations_with_replacement(range(x.shape[1]), d)
    ]
    terms = np.stack([z[:, chosen].prod(axis=1) for chosen in powers], axis=1)
    return terms @ np.linalg.lstsq(terms[train], y[train], rcond=None)[0]


class AsuLog(NamedTuple):
    """Log of the two-section pneumatic arm of ASU RISE."""

    time_s: np.ndarray  # (n,)
    pressure_kpa: np.ndarray  # (n, 6) measured in section 1, then section 2, relative to the atmosphere
    wire_m: np.ndarray  # (n, 4) draw wires from the base: section 1 left, 1 right, 2 right, 2 left
    position_m: np.ndarray  # (n, 3, 3) base, middle, tip
    quaternion: np.ndarray  # (n, 3, 4) w, x, y, z as logged
    fresh: np.ndarray  # (n,) whether every body has moved since the row before

    @property
    def section_m(self) -> np.ndarray:
        """Length (n,) [m] of the first section, from its base to its end."""
        return np.linalg.norm(self.position_m[:, 1] - self.position_m[:, 0], axis=1)


class TrunkLog(NamedTuple):
    """Log of the three-segment tendon-driven trunk of Stanford ASL."""

    motor_deg: np.ndarray  # (n, 6) measured
    position_m: np.ndarray  # (n, 3, 3) disks from the base, the last being the tip; y up
    quaternion: np.ndarray | None  # (n, 3, 4) w, x, y, z as logged
    fresh: np.ndarray  # (n,) whether the tip has moved since the row before


def read_asu(path: Path) -> AsuLog:
    """Read one `*_data_collect_*.txt`: 38 columns, no header, pressures in psi, quaternions scalar last.

    Raises:
        LogError: the file is not such a log; the message names line and column.
    """
    kinds = ("desired", "measured")
    pressures = [f"{kind}{k}" for half in (0, 3) for kind in kinds for k in range(half, half + 3)]
    axes = ("x", "y", "z", "qx", "qy", "qz", "qw")
    bodies = [f"{body}_{axis}" for body in range(N_BODIES) for axis in axes]
    values = _columns(path, ["time", *pressures, *(f"wire{k}" for k in range(4)), *bodies], header=False)
    # (n, sections, desired and measured, 3) -> (n, desired and measured, 6)
    psi = np.swapaxes(values[:, 1:13].reshape(-1, 2, 2, 3), 1, 2).reshape(-1, 2, 6)
    body = values[:, 17:].reshape(-1, N_BODIES, 7)
    return AsuLog(
        time_s=values[:, 0],
        pressure_kpa=UNITS["pressure"]["psi"] * psi[:, 1],
        wire_m=WIRE_M_PER_V * values[:, 13:17],
        position_m=body[..., :3],
        quaternion=body[..., [6, 3, 4, 5]],
        fresh=~np.any([checks.stale_rows(body[:, k]) for k in range(N_BODIES)], axis=0),
    )


def read_trunk(path: Path) -> TrunkLog:
    """Read one `observations_controlled_*.csv`, with or without quaternions.

    Raises:
        LogError: the file is not such a log; the message names line and column.
    """
    disks = range(1, N_BODIES + 1)
    positions = [f"{axis}{disk}" for disk in disks for axis in "xyz"]
    parts = [f"{part}{disk}" for disk in disks for part in ("w", "qx", "qy", "qz")]
    turns = "w1" in read_table(path).names
    names = [*positions, *(f"phi{k}" for k in range(1, 7)), *(parts if turns else [])]
    values = _columns(path, names, header=True)
    position_m = values[:, :9].reshape(-1, N_BODIES, 3)
    quaternion = values[:, 15:].reshape(-1, N_BODIES, 4) if turns else None
    return TrunkLog(values[:, 9:15], position_m, quaternion, ~checks.stale_rows(position_m[:, -1]))


def _columns(path: Path, names: list[str], header: bool) -> np.ndarray:
    """Return the columns (n, k) of a file by their names, from its header or as given."""
    table = read_table(path, None if header else names)
    if missing := [name for name in names if name not in table.names]:
        problem = "got no such columns, expected those of the public log"
        raise LogError([Finding(str(path), (1, 1), ", ".join(missing), problem)])
    values = table.values[:, [table.names.index(name) for name in names]]
    if len(bad := np.argwhere(~np.isfinite(values))):
        row, column = bad[0]
        line = int(table.row[row])
        problem = f"got {values[row, column]}, expected a finite number"
        raise LogError([Finding(str(path), (line, line), names[column], problem)])
    return values
