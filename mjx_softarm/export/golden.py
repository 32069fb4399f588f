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

`mjx_softarm.export.golden_cases` chooses the rows.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.link import vented
from mjx_softarm.deploy.loop import in_force, refusals, start, step, with_goal
from mjx_softarm.deploy.safety import Event, Fault

SCHEMA_VERSION = 2  # version of the file
PROGRAM_VERSION = 2  # version of the rows that a program reads and writes
AXES = ("x", "y", "z", "yaw", "pitch", "roll")
FLAGS = ("restart", "new_goal", "late", "taken", "lost", "checked")
BITS = {fault: 1 << k for k, fault in enumerate(Fault)}


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
            self.state, tick = step(self.controller, self.state, row[len(FLAGS) : -6], bool(late))
            self.stopped = tick.stop is not None
            events, arrived = refused + tick.events, tick.arrived
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
            self.state, refused = with_goal(self.controller, self.state, goal)
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
