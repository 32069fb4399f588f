"""Accuracy of a policy on an arm: errors at goals by motion capture. NumPy only.

Each error is the mean over the window in which the springs had settled, since motion capture is noisy.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm.control import saturated
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.deploy.session import LoopRun
from mjx_softarm.logs.tables import read_table
from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.policy.file import Policy
from mjx_softarm.posture import posture, straight_pose
from mjx_softarm.sensing.pose import frame_from_pose, pose_error, pose_from_frame, rotation_about, seen_error

MOST_LAG_S = 3.0  # largest lag of a tip behind a moving goal that is looked for
POSE_NAMES = ("x_mm", "y_mm", "z_mm", "yaw_deg", "pitch_deg", "roll_deg")
GOAL_COLUMNS = ("x [mm]", "y [mm]", "z [mm]", "yaw [deg]", "pitch [deg]", "roll [deg]")


class Accuracy(NamedTuple):
    """Arm at rest on arrival at p goals, in the mean of a window; NaN where a goal was missed."""

    goal: np.ndarray  # (p, 6) [mm, deg]
    error: np.ndarray  # (p, 6) [mm, deg] of the tip by motion capture, NaN where it was not seen
    believed: np.ndarray  # (p, 6) [mm, deg] believed pose minus the goal
    spring_m: np.ndarray  # (p, n_springs) lengths read, NaN where none was
    reference_m: np.ndarray  # (p, n_springs)
    saturated: np.ndarray  # (p, n_chambers) bool: a chamber at its limit, off its reference
    load_kg: np.ndarray  # (p,) believed payload


def read_goals(name: str, policy: Policy, n: int) -> np.ndarray:
    """Return goals (p, 6) [mm, deg] by name: `circle` and `grid` of at most n poses, or a CSV file.

    Around the circle the last plate is that of the straight arm, with motion capture's frame as calibrated.

    Raises:
        InputError: there is no such file, or it has other columns.
    """
    if name == "circle":
        position_m, _ = frame_from_pose(circle_poses(policy.spec, n).astype(float))
        turn = posture(policy.spec) @ rotation_about(np.radians(policy.spec.mounting.tip_turn_deg))
        return np.asarray(pose_from_frame(position_m, np.broadcast_to(turn, (n, 3, 3))))
    if name == "grid":
        return grid_poses(policy.workspace, n)
    if not Path(name).is_file():
        raise InputError(f"--goals: got {name}, expected circle, grid or a CSV file")
    table = read_table(name)
    if table.names not in (GOAL_COLUMNS, GOAL_COLUMNS[:3]):
        expected = f"the columns {','.join(GOAL_COLUMNS)}, or the first three"
        raise InputError(f"{name}: got {','.join(table.names)}, expected {expected}")
    for row, column in np.argwhere(~np.isfinite(table.values))[:1]:
        where = f"{name}: row {table.row[row]}: {table.names[column]}"
        raise InputError(f"{where}: got {table.values[row, column]}, expected a finite number")
    return np.array([whole_goal(goal, policy, name) for goal in table.values])


def whole_goal(goal: Sequence[float], policy: Policy, where: str) -> np.ndarray:
    """Return a goal (6,) [mm, deg] that is given as such, or by its position (3,); then angles do not matter.

    Raises:
        InputError: it is a position, and the policy's goals have a rotation.
    """
    if len(goal) == 6:
        return np.array(goal)
    if any(policy.reward.asked[3:]):
        raise InputError(
            f"{where}: got a position alone, expected X,Y,Z,YAW,PITCH,ROLL: only a policy that was trained "
            "with --env.reward.axes 1 1 1 0 0 0 takes positions"
        )
    return np.append(goal, straight_pose(policy.spec)[3:])


def grid_poses(workspace: np.ndarray, n: int) -> np.ndarray:
    """Return up to n of the workspace's poses (m, 6) [mm, deg], one in each cell of a cubic grid.

    The grid is the finest with at most n cells that hold a pose. Each cell gives the pose nearest its middle.
    """
    low, high = workspace[:, :3].min(axis=0), workspace[:, :3].max(axis=0)
    chosen = np.zeros(1, int)
    for n_cells in range(1, n + 1):  # along the longest side
        size = (high - low).max() / n_cells + 1e-6
        cell = (workspace[:, :3] - low) / size
        away = np.linalg.norm(cell - np.floor(cell) - 0.5, axis=1)
        order = np.argsort(away)
        _, first = np.unique(np.floor(cell[order]), axis=0, return_index=True)
        if len(first) > n:
            break
        chosen = order[first]
    return np.asarray(workspace[chosen], float)


def measure(run: LoopRun, controller: Controller, goals: np.ndarray) -> Accuracy:
    """Return the accuracy of a run towards goals (p, 6) [mm, deg], on an arm with motion capture.

    Raises:
        InputError: motion capture saw nothing.
    """
    log = run.log
    policy = controller.policy
    error, believed = np.full((2, len(goals), 6), np.nan)
    spring_m, reference_m = np.full((2, len(goals), policy.spec.n_springs), np.nan)
    mask = np.zeros((len(goals), policy.spec.n_chambers), bool)
    load_kg = np.full(len(goals), np.nan)
    for arrival in run.arrivals:
        if log.tip_m is None or log.tip_quaternion is None:
            raise InputError(f"motion capture: got no frame in {len(log)} ticks, expected the tip")
        assert log.pressure_kpa is not None and log.reference_m is not None
        assert log.readings is not None and log.load_kg is not None
        k = arrival.index
        rows = slice(max(0, arrival.row + 1 - controller.window), arrival.row + 1)
        error[k] = seen_error(log.tip_m[rows], log.tip_quaternion[rows], arrival.goal)
        believed[k] = pose_error(np.asarray(arrival.estimate, float), arrival.goal)
        spring_m[k] = _finite_mean(policy.sensor.lengths(log.readings[rows], np.nan).length_m)
        reference_m[k] = log.reference_m[arrival.row]
        mean_kpa = _finite_mean(log.pressure_kpa[rows])
        law = policy.gains.measured()
        mask[k] = saturated(mean_kpa, reference_m[k], spring_m[k], law, policy.tolerance_m)
        load_kg[k] = log.load_kg[arrival.row]
    return Accuracy(goals, error, believed, spring_m, reference_m, mask, load_kg)


def _finite_mean(values: np.ndarray) -> np.ndarray:
    """Return the means (n,) of the rows of values (k, n) that are finite; NaN if none is."""
    rows = values[np.isfinite(values).all(axis=1)]
    return rows.mean(axis=0) if len(rows) else np.full(values.shape[1], np.nan)


def figures(
    accuracy: Accuracy, events: Mapping[Fault, int], asked: Sequence[bool] = (True,) * 6
) -> dict[str, Any]:
    """Return the figures of an accuracy, with the number of events of each fault; NaN if none was measured.

    A goal is measured if the tip arrived and was seen, at any distance. Translation is the norm of the errors
    of x, y and z, rotation that of yaw, pitch and roll; both leave out axes that goals do not ask for.
    """
    measured = np.isfinite(accuracy.error).all(axis=1)
    n_measured = int(measured.sum())
    error, believed = (
        values[measured] if n_measured else np.full((1, 6), np.nan)
        for values in (accuracy.error, accuracy.believed)
    )
    away, turned = _norms(error, asked)
    per_point = accuracy.saturated.sum(axis=1)
    return {
        "points": len(accuracy.goal),
        "measured": n_measured,
        "translation_mm": float(away.mean()),
        "translation_95_mm": float(np.quantile(away, 0.95)),
        "rmse_mm": float(np.sqrt(np.mean(away**2))),
        "max_mm": float(away.max()),
        "rotation_deg": float(turned.mean()),
        "rotation_95_deg": float(np.quantile(turned, 0.95)),
        "rotation_max_deg": float(turned.max()),
        **dict(zip(POSE_NAMES, np.where(asked, np.abs(error).mean(axis=0), np.nan).tolist(), strict=True)),
        "believed_mm": float(_norms(believed, asked)[0].mean()),
        "load_estimate_g": float((1e3 * accuracy.load_kg[measured]).mean()) if n_measured else np.nan,
        "saturated_points": int(np.count_nonzero(per_point)),
        "saturated_chambers_max": int(per_point.max()),
        "saturation_events": int(events.get(Fault.SATURATED, 0)),
        "events": {fault.value: int(n) for fault, n in events.items() if n},
    }


def _norms(error: np.ndarray, asked: Sequence[bool]) -> tuple[np.ndarray, np.ndarray]:
    """Return the norms (p,) of translation and rotation of errors (p, 6) on the asked axes, NaN for none."""
    square = np.where(asked, error, 0.0) ** 2
    away, turned = np.sqrt(square[:, :3].sum(axis=1)), np.sqrt(square[:, 3:].sum(axis=1))
    return away if any(asked[:3]) else away * np.nan, turned if any(asked[3:]) else turned * np.nan


Way = tuple[np.ndarray, np.ndarray]  # tips by motion capture, NaN where not seen, and goals (n, 3) [mm] each


def ways_of(run: LoopRun) -> list[Way]:
    """Return tips and goals of the ticks of each way on which the goal moved; motion capture saw the tip."""
    assert run.log.goal is not None and run.log.tip_m is not None
    return [(1e3 * run.log.tip_m[rows], run.log.goal[rows, :3]) for rows in run.ways]


def along(ways: Sequence[Way], dt_s: float) -> dict[str, float]:
    """Return the tip's distances [mm] from a moving goal at the same time, and behind it by a lag.

    The lag [s], up to `MOST_LAG_S`, is that with the least mean distance. There is none without a frame.
    """

    def away_mm(lag: int) -> np.ndarray:
        each = [np.linalg.norm(tip[lag:] - goal[: len(goal) - lag], axis=1) for tip, goal in ways]
        return np.concatenate(each)

    # The lag is the one by which the tip's way fits the goal's best.
    lags = range(min(round(MOST_LAG_S / dt_s), max(len(goal) for _, goal in ways) - 1) + 1)
    means = [float(np.nanmean(away_mm(lag))) for lag in lags]
    best = int(np.argmin(means))
    now = away_mm(0)
    return {
        "way_mm": means[0],
        "way_95_mm": float(np.nanquantile(now, 0.95)),
        "way_max_mm": float(np.nanmax(now)),
        "lag_s": best * dt_s,
        "way_without_lag_mm": means[best],
        "way_s": len(now) * dt_s,
    }


def write_accuracy(
    folder: Path, accuracy: Accuracy, numbers: Mapping[str, Any], ways: Sequence[Way] = ()
) -> str:
    """Write `accuracy.json` and, with matplotlib, `accuracy.png`; return why there is no picture, or "".

    The picture shows the ways, if there are any, else the goals at which the arm has come to rest.
    """
    # Figures and the error at each goal
    points = [
        {"goal": goal.tolist(), "error": error.tolist() if np.isfinite(error).all() else None}
        for goal, error in zip(accuracy.goal, accuracy.error, strict=True)
    ]
    finite = {name: None if value != value else value for name, value in numbers.items()}
    text = json.dumps({**finite, "at": points}, indent=2, allow_nan=False)
    (folder / "accuracy.json").write_text(f"{text}\n", "utf-8")

    # Goals and tips from above and from the side; shares of the goals, or of the time, below an error
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return "no picture: matplotlib is not installed"
    figure = Figure(figsize=(10, 4), layout="constrained")
    above, side, shares = figure.subplots(1, 3)
    off = accuracy.error[:, :3]
    seen = accuracy.goal[:, :3] + off
    style = "."
    of_what = "goals"
    if ways:
        seen, goal = (np.concatenate(positions) for positions in zip(*ways, strict=True))
        off = seen - goal
        style = "-"
        of_what = "time"
    for axes, (i, j) in ((above, (0, 1)), (side, (0, 2))):
        axes.plot(accuracy.goal[:, i], accuracy.goal[:, j], "o", mfc="none", label="goal")
        axes.plot(seen[:, i], seen[:, j], style, label="measured")
        axes.set(xlabel=f"{'xyz'[i]} [mm]", ylabel=f"{'xyz'[j]} [mm]")
        axes.set_aspect("equal", adjustable="datalim")
    above.legend(loc="upper right")
    away = np.sort(np.linalg.norm(off[np.isfinite(off).all(axis=1)], axis=1))
    shares.plot(away, np.arange(1, len(away) + 1) / max(len(away), 1), drawstyle="steps-post")
    shares.set(xlabel="translation error [mm]", ylabel=f"share of the {of_what} below", ylim=(0, 1), xlim=0)
    figure.savefig(folder / "accuracy.png", dpi=150)
    return ""


def print_run(run: LoopRun, policy: Policy) -> None:
    """Print faults, times and reached goals of a run, and the reason for a missed goal."""
    for fault, count in run.counts().items():
        print(f"fault: {fault.value}: {count} times, {fault.response.value}")
    if len(run.latency_s):
        median, high = 1e3 * np.quantile(run.latency_s, (0.5, 0.999))
        n = len(run.latency_s)
        print(f"from readings to pressures: median {median:.2f} ms, 99.9 % {high:.2f} ms of {n} ticks")
    reached = f"{sum(arrival.reached for arrival in run.arrivals)} of {run.n_goals} goals reached"
    print(f"{reached}; the arm is {'' if run.ending.vented else 'NOT '}vented")

    # The error that a goal allows, and a reason for more
    if all(arrival.reached for arrival in run.arrivals):
        return
    reward = policy.reward
    for weights, unit, other in (
        (reward.weights[:3], "mm", "rotation"),
        (reward.weights[3:], "deg", "position"),
    ):
        if any(weights):
            within = f"{reward.threshold / max(weights):.2g} {unit}"
            print(f"a goal counts as reached within {within} if the {other} is exact")
    if not policy.calibrated:
        print(
            "the policy is not calibrated: it is expected to miss on an arm that differs from its "
            "specification; record a log, run `python -m calib run`, train and export (docs/your-arm.md)"
        )


def print_figures(numbers: dict[str, Any]) -> None:
    """Print the figures of an accuracy: a line for the path, if there is one, and one for the stops."""
    stops = f"{numbers['measured']} of {numbers['points']} goals"
    if "way_s" in numbers:
        print(
            f"path in {numbers['way_s']:.0f} s: mean error {numbers['way_mm']:.2f} mm, 95 % below "
            f"{numbers['way_95_mm']:.2f}, at most {numbers['way_max_mm']:.2f}; "
            f"delay {numbers['lag_s']:.2f} s, mean error without it {numbers['way_without_lag_mm']:.2f} mm"
        )
        stops = f"{numbers['measured']} stops"
    parts = [
        f"mean error {numbers[f'{name}_{unit}']:.2f} {unit}, 95 % below {numbers[f'{name}_95_{unit}']:.2f}, "
        f"at most {numbers[most]:.2f}"
        for name, unit, most in (("translation", "mm", "max_mm"), ("rotation", "deg", "rotation_max_deg"))
        if not np.isnan(numbers[f"{name}_{unit}"])  # goals ask for it
    ]
    n_saturated = numbers["saturated_points"]
    parts.append(f"saturated chambers at {n_saturated} of them" if n_saturated else "no chamber saturated")
    print(f"{stops}: {'; '.join(parts)}")


def print_origin(policy: Policy, arm: str) -> None:
    """Print what was trained in which simulation, and the arm that it ran on."""
    config = policy.provenance.get("train", {})
    env, learner = config.get("env", {}), config.get("learner", {})
    motion = "in motion" if env.get("mode") == "dynamic" else "at rest"
    trained = f"learned by {learner['name']} in engine {env['engine']}, {motion}" if learner else "no record"
    print(f"policy: preset {policy.provenance.get('preset') or 'unknown'}, {trained}; arm: {arm}")
