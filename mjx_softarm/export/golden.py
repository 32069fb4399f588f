"""Golden rows: answers of the control loop, row by row, that check the loop in any language.

The inputs of a row are one tick of the loop, the outputs are its answer:

    restart      1: begin anew, with an arm without pressure
    new_goal     1: take the goal of this row
    late         1: the last tick missed its deadline
    taken        0: the arm did not take the last pressures
    lost         1: the driver cannot reach the arm
    checked      1: refuse the goal if no pressures reach it, as before a run
    reading<k>   readings of the sensors; nan for a missing reading
    goal_<axis>  [mm, deg]
    faults       sum of 2**k over the faults of this tick, k counted in `mjx_softarm.deploy.safety.Fault`
    arrived      1: the springs have settled, and no further action is due
    pressure<k>  [kPa] pressures to write; after a fault that vents, a ramp to zero
    reference<k> [m] references of the springs
    length<k>    [m] lengths of the springs, as the loop believes
    pose_<axis>  [mm, deg] of the tip, estimated from these lengths

The first `N_SINGLE` rows each begin anew: they check the policy's answer to readings and a goal. At most
`N_CHECKED` more rows have checked goals. The other rows are runs of the loop with faults, on an arm that
follows the policy's own spring model.
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
from mjx_softarm.deploy.goals import refusals, with_goal
from mjx_softarm.deploy.link import vented
from mjx_softarm.deploy.loop import in_force, start, step
from mjx_softarm.deploy.safety import Event, Fault, stop_of
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.reach import nearest, nearest_poses
from mjx_softarm.sensing.estimator import expected_springs
from mjx_softarm.sensing.load import estimate_load

SCHEMA_VERSION = 2  # version of the file
PROGRAM_VERSION = 2  # version of the rows that a program reads and writes
AXES = ("x", "y", "z", "yaw", "pitch", "roll")
FLAGS = ("restart", "new_goal", "late", "taken", "lost", "checked")
BITS = {fault: 1 << k for k, fault in enumerate(Fault)}
N_SINGLE, N_CHECKED = 1000, 40  # numbers of rows

# Rounding at which a run ends, as a share of the pressures' range; others may round ten times worse.
_ROUNDED = 1e-5
_SPREAD_M = 2e-3  # standard deviation of the springs in single rows from the model, as by payloads
_OUTSIDE, _LOST = 0.1, 0.1  # shares of single rows with a goal outside, and with a lost reading
_LAG, _NOISE_M = 0.15, 4e-5  # share of the way to the commanded pressure per tick; noise of lengths
_SWING_M, _SHAKE_M = 2e-3, 1e-3  # amplitudes of springs that never rest
_CANDIDATES = 200  # number of goals from which the checked goals are chosen
_REACHED, _MISSED = 0.5, 1.5  # errors of clearly reached and clearly missed goals, over the threshold
_SHIFT = 0.01  # shift [mm, deg] under which these errors must stay clear, since a search has rounding errors
_RUNS = ("calm", "lost", "stuck", "late", "leaking", "unplugged", "swinging", "heavy", "pressed", "dropping")
_RUNS += ("shaken",)  # springs shake and a chamber leaks, so that it is lost in motion
_RUN_TICKS = 400  # longest run
_HEAVY, _PRESSED, _CARRIED = 1.5, 1.8, 0.8  # payloads of runs, as shares of the largest
_DROP_TICK = 200  # tick at which the carried payload falls, and the goal is given again
_WEIGHT_MAX_KPA = 8.0  # largest pressure that stands for a payload


class Golden(NamedTuple):
    """Rows with their answers."""

    about: dict[str, Any]  # schema_version, policy_sha256, n and n_chambers, the range of each output column
    inputs: np.ndarray  # (rows, 6 + n_springs + 6)
    outputs: np.ndarray  # (rows, 2 + n_chambers + 2 n_springs + 6)

    @property
    def n_springs(self) -> int:
        return self.about["n"]

    @property
    def n_chambers(self) -> int:
        return self.about["n_chambers"]

    def input_columns(self) -> list[str]:
        """Return the names of a row's inputs."""
        return [*FLAGS, *(f"reading{k}" for k in range(self.n_springs)), *(f"goal_{axis}" for axis in AXES)]

    def output_columns(self) -> list[str]:
        """Return the names of a row's outputs."""
        pressures = [f"pressure{k}" for k in range(self.n_chambers)]
        springs = [f"{name}{k}" for name in ("reference", "length") for k in range(self.n_springs)]
        return ["faults", "arrived", *pressures, *springs, *(f"pose_{axis}" for axis in AXES)]


class Machine:
    """The control loop as a machine that answers rows."""

    def __init__(self, controller: Controller):
        self.controller = controller
        self._restart()

    def _restart(self) -> None:
        self.state, self.stopped = start(self.controller), False
        self._before_kpa = self.state.command.pressure_kpa

    def answer(self, row: np.ndarray) -> np.ndarray:
        """Return the outputs of inputs, with the columns of `Golden`."""
        restart, new_goal, late, taken, lost, checked = row[: len(FLAGS)] > 0.5
        # Follow the flags of events before this tick.
        if restart:
            self._restart()
        if not taken:
            self.state = in_force(self.state, self._before_kpa)
        self._before_kpa = self.state.command.pressure_kpa
        events, arrived = (), False
        if lost:
            events, self.stopped = (Event(Fault.ARM_LOST, "the driver cannot reach it"),), True
        # Vent, or take a tick of the loop.
        if self.stopped:
            self.state = in_force(self.state, vented(self._before_kpa, self.controller.dt_s))
        else:
            refused = self._take_goal(row[-6:], checked) if new_goal else ()
            self.state, raised = step(self.state, row[len(FLAGS) : -6], bool(late))
            self.stopped = stop_of(raised) is not None
            events, arrived = refused + raised, self.state.arrived
        # Collect the outputs.
        belief, command = self.state.belief, self.state.command
        spring_m, nothing = belief.spring_m, np.full_like(belief.spring_m, np.nan)
        reference_m = nothing if command.reference_m is None else command.reference_m
        faults = sum({BITS[event.fault] for event in events})
        return np.concat([[faults, arrived], command.pressure_kpa, reference_m, spring_m, belief.pose])

    def _take_goal(self, goal: np.ndarray, checked: bool) -> tuple[Event, ...]:
        """Take a goal; return the reasons if it is refused."""
        refused = tuple(refusals(self.controller.policy, [goal]).values()) if checked else ()
        if not refused:
            self.state, refused = with_goal(self.state, goal)
        return refused


def write_golden(path: Path, golden: Golden) -> None:
    """Write rows as CSV, between a line of JSON and a checksum."""
    table = np.concat([golden.inputs, golden.outputs], axis=1)
    lines = [",".join(f"{value:.9g}" for value in row) for row in table]
    header = ",".join(golden.input_columns() + golden.output_columns())
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
    n_inputs = len(FLAGS) + about["n"] + len(AXES)
    return Golden(about, table[:, :n_inputs], table[:, n_inputs:])


def make_golden(controller: Controller, policy_sha256: str) -> Golden:
    """Make rows with all faults of an arm, and let the loop answer them.

    Rows replay readings that do not depend on the answered pressures, so rounding errors add up. A run ends
    once the pressures of a policy with rounded weights differ too much.
    """
    rng, machine = np.random.default_rng(1), Machine(controller)  # rounding ends no run before its fault
    rounded, most_kpa = Machine(_rounded(controller)), _ROUNDED * _ranges(controller)[2]
    inputs, outputs = [], []
    # Rows without memory, and checked goals.
    for row in (*_single_rows(controller, rng), *_checked_rows(controller, rng)):
        inputs.append(row)
        outputs.append(machine.answer(row))
    # Runs, until they arrive, are vented, or rounding has added up.
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
    # Scales of the outputs, for comparisons.
    spec = controller.policy.spec
    about = {"schema_version": SCHEMA_VERSION, "policy_sha256": policy_sha256}
    about |= {"n": spec.n_springs, "n_chambers": spec.n_chambers, "range": _ranges(controller).tolist()}
    return Golden(about, np.array(inputs), np.array(outputs))


def _rounded(controller: Controller) -> Controller:
    """Return a controller whose policy's weights differ in about their last bit."""
    rng, policy = np.random.default_rng(1), controller.policy
    layers = [(np.float32(w * (1.0 + 1e-7 * rng.normal(size=w.shape))), bias) for w, bias in policy.layers]
    return Controller.of(dataclasses.replace(policy, layers=tuple(layers)))


def _ranges(controller: Controller) -> np.ndarray:
    """Return the range of each output; 0 for outputs that must be equal."""
    policy = controller.policy
    ones, chamber = np.ones(policy.spec.n_springs), np.ones(policy.spec.n_chambers)
    pressure_kpa = chamber * policy.gains.pressure_max_kpa - chamber * policy.gains.pressure_min_kpa
    length_m = policy.actions.lengths(ones) - policy.actions.lengths(-ones)
    pose = np.concat([6.0 * policy.obs_scale.scale[:3], np.full(3, 360.0)])  # twice the arm's length
    return np.concat([np.zeros(2), pressure_kpa, length_m, length_m, pose])


def _row(flags: tuple[int, ...], readings: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return a row whose numbers survive nine digits of text."""
    return np.array([float(f"{value:.9g}") for value in (*flags, *readings, *goal)])


def _single_rows(controller: Controller, rng: np.random.Generator) -> Iterator[np.ndarray]:
    policy, n = controller.policy, controller.policy.spec.n_springs
    low, high = policy.sensor.range
    limits_kpa = policy.gains.pressure_min_kpa, policy.gains.pressure_max_kpa
    for _ in range(N_SINGLE):
        kpa = rng.uniform(*limits_kpa, policy.spec.n_chambers)
        spring_m = expected_springs(policy.spring_model, kpa) + rng.normal(0.0, _SPREAD_M, n)
        readings = policy.sensor.readings(spring_m)
        if rng.random() < _LOST:
            readings[rng.integers(n)] = rng.choice([np.nan, np.min(low) - 1.0, 2.0 * np.max(high)])
        yield _row((1, 1, 0, 1, 0, 0), readings, _goal(controller, rng, outside=rng.random() < _OUTSIDE))


def _checked_rows(controller: Controller, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield goals inside the workspace: up to half of N_CHECKED beyond reach, up to half within."""
    policy, n = controller.policy, controller.policy.spec.n_chambers
    goals = rng.choice(policy.workspace, _CANDIDATES)
    goals = goals + rng.normal(0.0, [5.0] * 3 + [30.0] * 3, goals.shape)
    goals = goals[[nearest(controller.reachable, goal)[1] < 0.98 for goal in goals]]
    errors = np.array([nearest_poses(policy, goals + shift)[1] for shift in (-_SHIFT, 0.0, _SHIFT)])
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
        away = nearest(controller.reachable, goal)[1]
        if away > 1.02 if outside else away < 0.98:
            return goal


def _rows_of_run(
    controller: Controller, kind: str, rng: np.random.Generator
) -> Generator[np.ndarray, np.ndarray, None]:
    """Yield the rows of a run with a fault; each `send` takes the pressures that the loop answered."""
    policy, spec, n = controller.policy, controller.policy.spec, controller.policy.spec.n_springs
    actual_kpa, goal = np.zeros(spec.n_chambers), _goal(controller, rng, outside=False)
    leak, first, longest_m = np.ones(spec.n_chambers), None, policy.actions.lengths(np.ones(n))
    carried = {"heavy": _HEAVY, "pressed": _PRESSED, "dropping": _CARRIED}.get(kind, 0.0)
    for tick in range(10**6):
        if kind == "dropping" and tick == _DROP_TICK:
            carried = 0.0
        # Springs of the arm under its pressures and its payload.
        weight_kpa = _weight_kpa(policy, actual_kpa, carried) if carried else 0.0
        spring_m = expected_springs(policy.spring_model, actual_kpa - weight_kpa)
        spring_m = spring_m + rng.normal(0.0, _NOISE_M, n)
        # Springs that are never all at rest.
        phase = 2 * np.pi * 0.7 * tick * controller.dt_s + np.arange(n)
        if kind == "shaken":
            spring_m = spring_m + _SHAKE_M * np.sin(phase)
        if kind == "swinging":  # near the longest lengths, so that the law drives every chamber to its limit
            spring_m = longest_m - _SWING_M * (1.0 - np.sin(phase))
        # Readings, with faults of the sensors.
        readings = policy.sensor.readings(spring_m)
        first = readings if first is None else first
        if kind == "lost" and (tick in (30, 40) or tick >= 60):
            readings = np.where(np.arange(n) == tick % n, np.nan, readings)
            readings = np.where((np.arange(n) == 4) & (tick >= 60), np.nan, readings)
        if kind == "stuck":
            readings[-1] = first[-1]
        # Flags, and the arm's answer to the pressures.
        late = kind == "late" and (tick in (20, 22) or tick >= 60)
        lost = kind == "unplugged" and tick == 60
        new_goal = tick == 0 or (kind == "dropping" and tick == _DROP_TICK)
        flags = (tick == 0, new_goal, late, not (late and tick % 2 == 0), lost, False)
        pressure_kpa = yield _row(tuple(map(int, flags)), readings, goal)
        if kind in ("leaking", "shaken") and tick == 60:
            leak[np.argmax(np.abs(pressure_kpa))] = 0.0
        actual_kpa = actual_kpa + _LAG * (leak * pressure_kpa - actual_kpa)


def _weight_kpa(policy: Policy, pressure_kpa: np.ndarray, share: float) -> float:
    """Return the pressure [kPa] that stands for a share of the largest payload, by the load's network.

    An arm seems to carry this payload if each chamber has this much more pressure than its springs show.
    """
    model, less_kpa = policy.load_estimator, np.linspace(-_WEIGHT_MAX_KPA, _WEIGHT_MAX_KPA, 201)
    shown_kpa = pressure_kpa - less_kpa[:, None]  # (201, n_chambers)
    spring_m = expected_springs(policy.spring_model, shown_kpa)
    estimate_kg, _ = estimate_load(model, spring_m, np.broadcast_to(pressure_kpa, shown_kpa.shape))
    return float(less_kpa[np.argmin(np.abs(estimate_kg - share * model.load_scale_kg))])
