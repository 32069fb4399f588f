"""Comparison of golden rows with the answers of a policy file, an ONNX graph or a program."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm._support.errors import InputError, needing
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.export.golden import BITS, FLAGS, PROGRAM_VERSION, Golden, Machine
from mjx_softarm.policy.file import load_policy

TOLERANCE = 1e-4  # share of an output's range; the law adds up rounding errors of float32 references
_TIMEOUT_S = 120.0


class Agreement(NamedTuple):
    """Comparison of answers with golden ones."""

    n_rows: int
    error: float  # largest error, as a share of the output's range; infinite if a fault differs
    column: str  # output with the largest error
    row: int  # row with the largest error, from 0

    @property
    def holds(self) -> bool:
        return self.error <= TOLERANCE

    def __str__(self) -> str:
        verdict = "agree" if self.holds else "DO NOT AGREE"
        where = f"({self.column}, row {self.row})"
        return f"{self.n_rows} rows {verdict}, greatest difference {self.error:.1e} of the range {where}"


def check(golden: Golden, path: Path) -> Agreement:
    """Compare the answers of a runtime with golden ones.

    Args:
        golden: golden rows.
        path: policy file `.npz`, graph `.onnx`, or a program that reads rows and writes their outputs.

    Raises:
        InputError: the file cannot be read as such, is of another policy, or the program failed.
    """
    answer = {".npz": _by_numpy, ".onnx": _by_onnx}.get(path.suffix, _by_program)
    rows, outputs = answer(golden, path)
    return compare(golden, rows, outputs)


def compare(golden: Golden, rows: np.ndarray, outputs: dict[str, np.ndarray]) -> Agreement:
    """Compare outputs (k,), by the names of their columns, with those of the golden rows `rows` (k,)."""
    names = golden.output_columns()
    worst = Agreement(len(rows), 0.0, "none", 0)
    for name, got in outputs.items():
        column = names.index(name)
        expected = golden.outputs[rows, column]
        scale = golden.about["range"][column]
        off = np.abs(got - expected)
        if name in ("pose_yaw", "pose_pitch", "pose_roll"):
            off = np.minimum(off, 360.0 - off)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(off == 0.0, 0.0, off / scale)
        share = np.where(np.isnan(got) & np.isnan(expected), 0.0, np.where(np.isnan(off), np.inf, share))
        if share.max() >= worst.error:
            worst = Agreement(len(rows), float(share.max()), name, int(rows[share.argmax()]))
    return worst


def _same_policy(path: Path, sha256: Any, golden: Golden) -> None:
    expected = golden.about["policy_sha256"]
    if sha256 != expected:
        raise InputError(f"{path}: got policy {str(sha256)[:12]}, expected {expected[:12]}, the golden rows'")


def _by_numpy(golden: Golden, path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    policy = load_policy(path)
    _same_policy(path, hashlib.sha256(path.read_bytes()).hexdigest(), golden)
    machine = Machine(Controller.of(policy))
    answers = np.array([machine.answer(row) for row in golden.inputs])
    return np.arange(len(answers)), _columns(golden, answers)


def _by_onnx(golden: Golden, path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    with needing("onnx", str(path)):
        import onnxruntime

        from mjx_softarm.export.onnx_files import read_onnx
    data, about = read_onnx(path)
    _same_policy(path, about["policy_sha256"], golden)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    names = [item.name for item in session.get_outputs()]

    def answer(inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        arrays: Any = session.run(None, inputs)
        return dict(zip(names, arrays, strict=True))

    if about["kind"] == "check of goals":
        return _checked(golden, lambda goal: bool(answer({"goal": goal})["goal_outside"]))
    if about["kind"] != "policy":
        raise InputError(f"{path}: got {about['kind']}, expected the graph from readings to references")
    return without_memory(golden, lambda readings, goal: answer({"readings": readings, "goal": goal}))


def without_memory(golden: Golden, answer: Callable) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the golden rows that depend only on readings and goal, and their outputs by column.

    `answer` takes readings (n_springs,) and a goal (6,), float32, and gives the outputs of
    `computations.answer`.
    """
    rows = np.flatnonzero(golden.inputs[:, FLAGS.index("restart")] > golden.inputs[:, FLAGS.index("checked")])
    answers = []
    for row in golden.inputs[rows].astype(np.float32):
        result = answer(row[len(FLAGS) : -6], row[-6:])
        acts = np.isfinite(result["reference_m"]).all()
        present = {
            Fault.LOST_READING: result["reading_lost"].any(),
            Fault.GOAL_OUTSIDE: result["goal_outside"],
            Fault.EXTRAPOLATION: acts and result["extrapolation"] > 1.0,
        }
        faults = sum(BITS[fault] for fault, there in present.items() if there)
        nothing = np.full(golden.n_chambers, np.nan)
        values = nothing, result["reference_m"], result["length_m"], result["pose"]
        answers.append(np.concat([[faults, 0.0], *values]))
    outputs = _columns(golden, np.array(answers))
    return rows, {name: value for name, value in outputs.items() if not name.startswith("pressure")}


def _checked(
    golden: Golden, outside: Callable[[np.ndarray], bool]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the golden rows with checked goals, and their faults; `outside` decides GOAL_OUTSIDE."""
    rows = np.flatnonzero(golden.inputs[:, FLAGS.index("checked")])
    bit = BITS[Fault.GOAL_OUTSIDE]
    bits = np.array([bit * outside(goal) for goal in golden.inputs[rows, -6:].astype(np.float32)], int)
    return rows, {"faults": golden.outputs[rows, 0].astype(int) & ~bit | bits}


def _by_program(golden: Golden, path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    # Run the program.
    lines = [" ".join(f"{value:.9g}" for value in row) for row in golden.inputs]
    try:
        command = [str(path.resolve())]
        text = "\n".join([*lines, ""])
        done = subprocess.run(command, input=text, capture_output=True, text=True, timeout=_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired, UnicodeDecodeError) as error:
        raise InputError(f"{path}: got {error}, expected a program that runs") from error
    # Check its first line, then read its answers.
    first, *rest = done.stdout.splitlines() or [""]
    words = [*first.split(), *("",) * 4]
    if done.returncode or words[:2] != ["mjx_softarm", str(PROGRAM_VERSION)]:
        got = done.stderr.strip() or f"exit status {done.returncode}, first line {first!r}"
        expected = f"a program that answers rows of version {PROGRAM_VERSION}"
        raise InputError(f"{path}: got {got}, expected {expected}")
    _same_policy(path, words[2], golden)
    try:
        answers = np.array([line.split() for line in rest], float).reshape(golden.outputs.shape)
    except ValueError as error:
        got = f"{len(rest)} lines"
        expected = "{} lines of {} numbers".format(*golden.outputs.shape)
        raise InputError(f"{path}: got {got}, expected {expected}") from error
    return np.arange(len(answers)), _columns(golden, answers)


def _columns(golden: Golden, answers: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(golden.output_columns(), answers.T, strict=True))
