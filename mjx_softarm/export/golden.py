"""Golden rows: what the control loop answers, row by row, to check it in any language.

A row of inputs is one tick of the loop, and its answer the outputs:

    restart      1: begin anew, with an arm without pressure
    new_goal     1: take the goal of this row
    late         1: the last tick missed its deadline
    taken        0: the arm did not take the last pressures
    lost         1: the driver cannot reach the arm
    checked      1: refuse the goal if no pressures reach it, as before a run
    reading<k>   of the sensors; nan where none came
    goal_<axis>  [mm, deg]
    faults       sum of 2**k over the faults of this tick, k counted in `mjx_softarm.deploy.safety.Fault`
    arrived      1: the springs have settled, and no further action is due
    pressure<k>  [kPa] to write; after a fault whose response is to vent, a ramp to zero
    reference<k> [m]
    length<k>    [m] believed in
    pose_<axis>  [mm, deg] of the tip, estimated from these lengths

The first `N_SINGLE` rows each begin anew, so that each is the policy's answer to readings and a goal. At most
`N_CHECKED` more have checked goals. The others are runs of the loop, on an arm that follows the policy's own
spring model, with faults.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.link import vented
from mjx_softarm.deploy.loop import in_force, refusals, start, step, with_goal
from mjx_softarm.deploy.safety import Event, Fault
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.reach import nearest_poses
from mjx_softarm.policy.reachable import nearest
from mjx_softarm.sensing.estimator import expected_springs
from mjx_softarm.sensing.load import estimate_load

SCHEMA_VERSION = 2
N_SINGLE, N_CHECKED = 1000, 40
AXES = ("x", "y", "z", "yaw", "pitch", "roll")
FLAGS = ("restart", "new_goal", "late", "taken", "lost", "checked")
BITS = {fault: 1 << k for k, fault in enumerate(Fault)}

_ROUNDED = 1e-5  # share of the pressures' range; other runtimes may be some ten times as far off
_SPREAD_M = 2e-3  # of the springs of single rows around the model's, as by payloads
_OUTSIDE, _LOST = 0.1, 0.1  # shares of single rows
_LAG, _NOISE_M = 0.15, 4e-5  # of the arm in the runs, per tick
_SWING_M, _SHAKE_M = 2e-3, 1e-3
_CANDIDATES = 200  # goals to choose checked ones from,
_REACHED, _MISSED = 0.8, 1.5  # whose errors over the threshold are this clear,
_SHIFT = 0.01  # also of the goals that are so far off, since a search is only as exact as its numbers
_RUNS = ("calm", "lost", "stuck", "late", "leaking", "unplugged", "swinging", "heavy", "pressed", "dropping")
_RUNS += ("shaken",)  # and leaking: a chamber is lost in motion
_RUN_TICKS = 400  # at most
_HEAVY, _PRESSED, _CARRIED = 1.45, 1.8, 0.8  # payloads of runs, as shares of the largest,
_DROP_TICK = 200  # and when the last one falls, and the goal is given again
_WEIGHT_MAX_KPA = 8.0


class Golden(NamedTuple):
    """Rows and answers."""

    about: dict[str, Any]  # schema_version, policy_sha256, n, and the range of each output column
    inputs: np.ndarray  # (rows, 6 + n + 6)
    outputs: np.ndarray  # (rows, 2 + 3 n + 6)


def input_columns(n: int) -> list[str]:
    """Return the names of a row's inputs."""
    return [*FLAGS, *(f"reading{k}" for k in range(n)), *(f"goal_{axis}" for axis in AXES)]


def output_columns(n: int) -> list[str]:
    """Return the names of a row's outputs."""
    springs = [f"{name}{k}" for name in ("pressure", "reference", "length") for k in range(n)]
    return ["faults", "arrived", *springs, *(f"pose_{axis}" for axis in AXES)]


class Machine:
    """The control loop as a machine that answers rows."""

    def __init__(self, controller: Controller):
        self.controller = controller
        self._restart()

    def _restart(self) -> None:
        self.state, self.stopped = start(self.controller), False
        self._before_kpa = self.state.command.pressure_kpa

    def answer(self, row: np.ndarray) -> np.ndarray:
        """Return the outputs (2 + 3 n + 6,) of inputs (6 + n + 6,)."""
        restart, new_goal, late, taken, lost, checked = row[: len(FLAGS)] > 0.5
        if restart:
            self._restart()
        if not taken:
            self.state = in_force(self.state, self._before_kpa)
        self._before_kpa = self.state.command.pressure_kpa
        events, arrived = (), False
        if lost:
            events, self.stopped = (Event(Fault.ARM_LOST, "the driver cannot reach it"),), True
        if self.stopped:
            self.state = in_force(self.state, vented(self._before_kpa, self.controller.dt_s))
        else:
            refused = self._take_goal(row[-6:], checked) if new_goal else ()
            self.state, tick = step(self.controller, self.state, row[len(FLAGS) : -6], bool(late))
            self.stopped = tick.stop is not None
            events, arrived = refused + tick.events, tick.arrived
        belief, command = self.state.belief, self.state.command
        spring_m, nothing = belief.spring_m, np.full_like(belief.spring_m, np.nan)
        reference_m = nothing if command.reference_m is None else command.reference_m
        faults = sum({BITS[event.fault] for event in events})
        return np.concat([[faults, arrived], command.pressure_kpa, reference_m, spring_m, belief.pose])

    def _take_goal(self, goal: np.ndarray, checked: bool) -> tuple[Event, ...]:
        """Take a goal; return why it was refused, if it was."""
        refused = tuple(refusals(self.controller.policy, [goal]).values()) if checked else ()
        if not refused:
            self.state, refused = with_goal(self.controller, self.state, goal)
        return refused


def make_golden(controller: Controller, policy_sha256: str, seed: int = 0) -> Golden:
    """Make rows that meet the faults of an arm, and let the loop answer them.

    Rows replay readings, which do not answer to the pressures, so rounding adds up. A run ends where the
    pressures of a policy with rounded weights have become too different.
    """
    rng, machine = np.random.default_rng(seed), Machine(controller)
    rounded, most_kpa = Machine(_rounded(controller)), _ROUNDED * _ranges(controller)[2]
    inputs, outputs = [], []
    for row in (*_single_rows(controller, rng), *_checked_rows(controller, rng)):
        inputs.append(row)
        outputs.append(machine.answer(row))
    for kind in _RUNS:
        run = _rows_of_run(controller, kind, rng)
        row = next(run)
        for tick in range(_RUN_TICKS * (2 if kind in ("swinging", "dropping") else 1)):
            inputs.append(row)
            outputs.append(machine.answer(row))
            rounded.answer(row)
            pressure_kpa = machine.state.command.pressure_kpa
            if np.abs(pressure_kpa - rounded.state.command.pressure_kpa).max() > most_kpa:
                break
            arrived = machine.state.goal is None and not (kind == "dropping" and tick < 2 * _DROP_TICK)
            if arrived or (machine.stopped and not pressure_kpa.any()):
                break
            row = run.send(pressure_kpa)
    n = controller.policy.spec.n_chambers
    about = {"schema_version": SCHEMA_VERSION, "policy_sha256": policy_sha256, "n": n}
    about["range"] = _ranges(controller).tolist()
    return Golden(about, np.array(inputs), np.array(outputs))


def _rounded(controller: Controller) -> Controller:
    """Return a controller whose policy has weights that differ in about their last bit."""
    rng, policy = np.random.default_rng(1), controller.policy
    layers = [(np.float32(w * (1.0 + 1e-7 * rng.normal(size=w.shape))), bias) for w, bias in policy.layers]
    return Controller.of(dataclasses.replace(policy, layers=tuple(layers)))


def _ranges(controller: Controller) -> np.ndarray:
    """Return the range (2 + 3 n + 6,) of each output, 0 where nothing but equality will do."""
    policy = controller.policy
    n, ones = policy.spec.n_chambers, np.ones(policy.spec.n_chambers)
    pressure_kpa = ones * policy.gains.pressure_max_kpa - ones * policy.gains.pressure_min_kpa
    length_m = policy.actions.lengths(ones) - policy.actions.lengths(-ones)
    pose = np.concat([6.0 * policy.obs_scale.scale[:3], np.full(3, 360.0)])  # twice the arm's length
    return np.concat([np.zeros(2), pressure_kpa, length_m, length_m, pose]).reshape(2 + 3 * n + 6)


def _row(flags: tuple[int, ...], readings: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return a row whose numbers survive nine digits of text."""
    return np.array([float(f"{value:.9g}") for value in (*flags, *readings, *goal)])


def _single_rows(controller: Controller, rng: np.random.Generator) -> Iterator[np.ndarray]:
    policy, n = controller.policy, controller.policy.spec.n_chambers
    low, high = policy.sensor.range
    for _ in range(N_SINGLE):
        kpa = rng.uniform(policy.gains.pressure_min_kpa, policy.gains.pressure_max_kpa, n)
        spring_m = expected_springs(policy.spring_model, kpa) + rng.normal(0.0, _SPREAD_M, n)
        readings = policy.sensor.readings(spring_m)
        if rng.random() < _LOST:
            readings[rng.integers(n)] = rng.choice([np.nan, np.min(low) - 1.0, 2.0 * np.max(high)])
        yield _row((1, 1, 0, 1, 0, 0), readings, _goal(controller, rng, outside=rng.random() < _OUTSIDE))


def _checked_rows(controller: Controller, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield goals within the workspace that pressures reach, and as many that none reach, if there are."""
    policy, n = controller.policy, controller.policy.spec.n_chambers
    goals = rng.choice(policy.workspace, _CANDIDATES) + rng.normal(
        0.0, [5.0] * 3 + [30.0] * 3, (_CANDIDATES, 6)
    )
    goals = goals[[nearest(controller.reachable, goal, policy.reward)[1] < 0.98 for goal in goals]]
    errors = np.array([nearest_poses(policy, goals + shift)[1] for shift in (0.0, _SHIFT)])
    least, most = errors.min(axis=0) / policy.reward.threshold, errors.max(axis=0) / policy.reward.threshold
    readings = policy.sensor.readings(expected_springs(policy.spring_model, np.zeros(n)))
    for chosen in (least > _MISSED, most < _REACHED):
        for goal in goals[chosen][: N_CHECKED // 2]:
            yield _row((1, 1, 0, 1, 0, 1), readings, goal)


def _goal(controller: Controller, rng: np.random.Generator, outside: bool) -> np.ndarray:
    """Return a pose close to a reachable one, or one that is clearly outside."""
    policy = controller.policy
    while True:
        goal = rng.choice(policy.workspace) + rng.normal(0.0, [2.0] * 3 + [1.0] * 3)
        goal = goal + outside * rng.normal(0.0, [300.0] * 3 + [0.0] * 3)
        away = nearest(controller.reachable, goal, policy.reward)[1]
        if away > 1.02 if outside else away < 0.98:
            return goal


def _rows_of_run(
    controller: Controller, kind: str, rng: np.random.Generator
) -> Generator[np.ndarray, np.ndarray, None]:
    """Yield rows of a run with a fault; takes the pressures that were answered."""
    policy, n = controller.policy, controller.policy.spec.n_chambers
    actual_kpa, goal = np.zeros(n), _goal(controller, rng, outside=False)
    leak, first, longest_m = np.ones(n), None, policy.actions.lengths(np.ones(n))
    carried = {"heavy": _HEAVY, "pressed": _PRESSED, "dropping": _CARRIED}.get(kind, 0.0)
    for tick in range(10**6):
        if kind == "dropping" and tick == _DROP_TICK:
            carried = 0.0
        weight_kpa = _weight_kpa(policy, actual_kpa, carried) if carried else 0.0
        spring_m = expected_springs(policy.spring_model, actual_kpa - weight_kpa)
        spring_m = spring_m + rng.normal(0.0, _NOISE_M, n)
        phase = 2 * np.pi * 0.7 * tick * controller.dt_s + np.arange(n)  # of springs that are never all still
        if kind == "shaken":
            spring_m = spring_m + _SHAKE_M * np.sin(phase)
        if kind == "swinging":  # so long that the law drives every chamber to its limit
            spring_m = longest_m - _SWING_M * (1.0 - np.sin(phase))
        readings = policy.sensor.readings(spring_m)
        first = readings if first is None else first
        if kind == "lost" and (tick in (30, 40) or tick >= 60):
            readings = np.where(np.arange(n) == tick % n, np.nan, readings)
            readings = np.where((np.arange(n) == 4) & (tick >= 60), np.nan, readings)
        if kind == "stuck":
            readings[-1] = first[-1]
        late = kind == "late" and (tick in (20, 22) or tick >= 60)
        lost = kind == "unplugged" and tick == 60
        new_goal = tick == 0 or (kind == "dropping" and tick == _DROP_TICK)
        flags = (tick == 0, new_goal, late, not (late and tick % 2 == 0), lost, False)
        pressure_kpa = yield _row(tuple(map(int, flags)), readings, goal)
        if kind in ("leaking", "shaken") and tick == 60:
            leak[np.argmax(np.abs(pressure_kpa))] = 0.0
        actual_kpa = actual_kpa + _LAG * (leak * pressure_kpa - actual_kpa)


def _weight_kpa(policy: Policy, pressure_kpa: np.ndarray, share: float) -> float:
    """Return the pressure [kPa] that a share of the largest payload stands for, by the load's network.

    An arm with so much more pressure in every chamber than its springs show seems to carry this payload.
    """
    model, less_kpa = policy.load_estimator, np.linspace(-_WEIGHT_MAX_KPA, _WEIGHT_MAX_KPA, 201)
    spring_m = expected_springs(policy.spring_model, pressure_kpa - less_kpa[:, None])
    estimate_kg = estimate_load(model, spring_m, np.broadcast_to(pressure_kpa, spring_m.shape))
    return float(less_kpa[np.argmin(np.abs(estimate_kg - share * model.load_scale_kg))])


def write_golden(path: Path, golden: Golden) -> None:
    """Write rows as CSV, between a line of JSON and a checksum."""
    n = golden.about["n"]
    table = np.concat([golden.inputs, golden.outputs], axis=1)
    lines = [",".join(f"{value:.9g}" for value in row) for row in table]
    header = ",".join(input_columns(n) + output_columns(n))
    text = "\n".join([f"# {json.dumps(golden.about)}", header, *lines, ""])
    path.write_text(f"{text}# {hashlib.sha256(text.encode()).hexdigest()}\n", "utf-8")


def read_golden(path: Path) -> Golden:
    """Read rows.

    Raises:
        InputError: the file cannot be read, is incomplete, changed or of another version.
    """
    expected = "an unchanged file of golden rows: policy_golden.csv of `--onnx`, golden.csv of `--cpp`"
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: got {error.strerror!r}, expected {expected}") from error
    body, seal = data[:-67], data[-67:]
    if seal != f"# {hashlib.sha256(body).hexdigest()}\n".encode():
        raise InputError(f"{path}: got {len(data)} bytes without their checksum, expected {expected}")
    first, _, *lines = body.decode().splitlines()
    about = json.loads(first[1:])
    if about.get("schema_version") != SCHEMA_VERSION:
        got = f"schema_version: got {about.get('schema_version')}, expected {SCHEMA_VERSION}"
        raise InputError(f"{path}: {got}; export the run again")
    table = np.array([line.split(",") for line in lines], float)
    n_inputs = len(input_columns(about["n"]))
    return Golden(about, table[:, :n_inputs], table[:, n_inputs:])
