"""The C++ header: compiled with warnings as errors and sanitizers, checked on golden rows."""

import dataclasses
import os
import shutil
import signal
import subprocess

import numpy as np
import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.export.check import TOLERANCE, check
from mjx_softarm.export.cpp import sources
from mjx_softarm.export.golden import FLAGS, Machine, read_golden
from mjx_softarm.export.write import export_cpp
from mjx_softarm.mdp.observation import OBS_SIZE
from mjx_softarm.policy.file import save_policy
from tests.arms import SIX_CHAMBERS, TAPERED
from tests.export.conftest import (
    busy_policy,
    carrying_policy,
    draw_wire_policy,
    few_golden_rows,
    moving_policy,
)
from tests.linear_arm import N

pytestmark = pytest.mark.skipif(not shutil.which("g++"), reason="there is no compiler g++ here")
STRICT = ("-std=c++17", "-Wall", "-Wextra", "-Werror")
SANITIZED = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
MATH = {"sin", "cos", "tan", "tanh", "atan2", "acos", "floor", "sqrt", "exp"}


def compile_(*arguments):
    done = subprocess.run(["g++", *STRICT, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:3000]


@pytest.fixture(scope="module")
def folder(controller, golden, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cpp")
    for name, text in sources(controller, golden.about["policy_sha256"]).items():
        (folder / name).write_text(text)
    compile_(*SANITIZED, folder / "rows.cpp", "-o", folder / "rows")
    return folder


def test_rows_agree_under_sanitizers(folder, golden):
    agreement = check(golden, folder / "rows")
    assert agreement.n_rows == len(golden.inputs) and agreement.error < TOLERANCE, agreement


def agreeing_rows(policy, folder, run_ticks):
    """Rows of a policy, on which the C++ of its export agrees; a run with two goals is twice as long."""
    save_policy(folder / "policy.npz", policy)
    with few_golden_rows(run_ticks):
        export_cpp(folder / "policy.npz", folder)
    compile_("-O0", folder / "rows.cpp", "-o", folder / "rows")
    golden = read_golden(folder / "golden.csv")
    agreement = check(golden, folder / "rows")
    assert agreement.n_rows > 100 and agreement.error < TOLERANCE, agreement
    return golden


def test_rows_of_redundant_chambers_agree(tmp_path):
    """They share the law's allocation."""
    agreeing_rows(busy_policy(SIX_CHAMBERS), tmp_path, run_ticks=100)


def test_rows_of_draw_wires_agree(tmp_path):
    agreeing_rows(draw_wire_policy(), tmp_path, run_ticks=30)


def test_rows_of_a_policy_that_observes_the_payload_agree(tmp_path):
    """A policy of an arm whose sections differ."""
    policy = carrying_policy(TAPERED)
    golden = agreeing_rows(policy, tmp_path, run_ticks=110)
    (weight, bias), *others = policy.layers
    blind = dataclasses.replace(
        policy, layers=((weight * (np.arange(len(weight)) < OBS_SIZE)[:, None], bias), *others)
    )
    machine = Machine(Controller.of(blind))
    off_m = np.array([machine.answer(row) for row in golden.inputs]) - golden.outputs
    assert np.nanmax(np.abs(off_m[:, 2 + N : 2 + 2 * N])) > 1e-3  # so a payload was estimated, and counts


def test_rows_of_a_policy_of_motion_agree_and_it_arrives(tmp_path):
    """So it took its last action, whose references are corrected."""
    assert agreeing_rows(moving_policy(), tmp_path, run_ticks=260).outputs[:, 1].any()


def test_a_tick_neither_allocates_nor_throws(folder):
    """All that its machine code calls are functions of <cmath> and of memory blocks."""
    (folder / "tick.cpp").write_text(
        '#include "softarm.hpp"\n'
        "bool run(softarm::Controller& c, const double* goal, const double* readings, float* pose) {\n"
        "  if (!softarm::reaches(goal, pose)) c.vent(softarm::ARM_LOST);\n"
        "  return c.set_goal(goal) && c.tip(pose) && c.tick(readings).vented;\n}\n"
    )
    compile_("-O1", "-fno-exceptions", "-fno-rtti", "-c", folder / "tick.cpp", "-o", folder / "tick.o")
    listed = subprocess.run(["nm", "-u", folder / "tick.o"], capture_output=True, text=True, check=True)
    called = {line.split()[-1] for line in listed.stdout.splitlines()}
    assert "tanhf" in called and "acos" in called
    allowed = MATH | {f"{name}f" for name in MATH} | {"sincos", "sincosf", "memcpy", "memmove", "memset"}
    assert called <= allowed | {"__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}


def test_example_vents_an_arm_that_gives_no_readings(folder):
    text = (folder / "example.cpp").read_text()
    assert text.count("\n") <= 52 and "@" not in text + (folder / "softarm.hpp").read_text()
    compile_(folder / "example.cpp", "-o", folder / "example")
    done = subprocess.run([folder / "example"], capture_output=True, text=True, timeout=30)
    assert done.returncode == 0 and done.stderr == ""
    assert done.stdout.splitlines()[-2:] == ["0.0 " * 8 + "0.0", "faults: 0x3, vents"]


READS = """
static bool read_sensors(double* readings) {
  static const double at_rest[kSprings] = {READINGS};
  static int tick = 0;
  for (int k = 0; k < kSprings; ++k) readings[k] = at_rest[k] * (1.0 + 1e-3 * (tick % 2));
  return ++tick > 0;
}
static bool write_pressures(const double* pressure_kpa) {
  static int refused = 0;
  double most = 0.0;
  for (int k = 0; k < kChambers; ++k) most = std::fmax(most, std::fabs(pressure_kpa[k]));
  std::fprintf(stderr, "%.17g\\n", most);
  return most > 0.0 || ++refused > 3;
}
"""


@pytest.fixture(scope="module")
def driven(folder, golden):
    """The example with readings of an arm that refuses the first zeros."""
    row = golden.inputs[np.flatnonzero(np.isfinite(golden.outputs).all(axis=1))[0]]
    text = (folder / "example.cpp").read_text()
    first, last = text.index("// Reads the springs' sensors"), text.index("// Ctrl-C")
    reads = READS.replace("READINGS", ", ".join(map(repr, row[len(FLAGS) : -6].tolist())))
    (folder / "driven.cpp").write_text(text[:first] + reads + text[last:])
    compile_(folder / "driven.cpp", "-o", folder / "driven")
    return folder / "driven"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_example_that_is_ended_vents_until_the_arm_has_taken_it(driven, number):
    with subprocess.Popen([driven], stderr=subprocess.PIPE, text=True) as done:
        assert done.stderr is not None
        before = [float(done.stderr.readline()) for _ in range(8)]
        done.send_signal(number)
        ramp = np.array([float(line) for line in done.stderr])
    assert done.returncode == 0 and before[-1] > 0.0
    falls = -np.diff(ramp[np.argmax(ramp) :])
    assert ((falls >= 0.0) & (falls < 0.4 + 1e-9)).all()  # 20 kPa/s
    assert not ramp[-4:].any() and ramp[-5] > 0.0  # three times refused


@pytest.mark.parametrize("option", ["-Ofast", "-ffinite-math-only"])
def test_header_refuses_mathematics_without_nan(folder, option):
    with pytest.raises(AssertionError, match="marks lost readings by NaN"):
        compile_("-fsyntax-only", option, folder / "rows.cpp")


@pytest.mark.skipif(not shutil.which("cmake"), reason="there is no cmake here")
def test_cmake_builds_both_programs(folder, tmp_path):
    for step in (["-S", folder, "-B", tmp_path, "-DCMAKE_BUILD_TYPE=Debug"], ["--build", tmp_path]):
        done = subprocess.run(["cmake", *step], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    assert os.access(tmp_path / "rows", os.X_OK) and os.access(tmp_path / "example", os.X_OK)


def test_other_programs_and_rows_are_refused(folder, golden, tmp_path):
    golden = golden._replace(inputs=golden.inputs[:3], outputs=golden.outputs[:3])
    other = golden._replace(about=golden.about | {"policy_sha256": "0" * 64})
    with pytest.raises(InputError, match="rows: got policy [0-9a-f]{12}, expected 000000000000"):
        check(other, folder / "rows")
    short = subprocess.run([folder / "rows"], input="1 1 0 1 0 0 0.2", capture_output=True, text=True)
    assert (short.returncode, short.stderr) == (2, "row 1: got 7 numbers, expected 21\n")
    program = tmp_path / "program"
    sha256 = golden.about["policy_sha256"]
    for script, message in (
        ("echo hello", "expected a program that answers rows of version 2"),
        (f"echo mjx_softarm 2 {sha256}; echo 1 2", r"got 1 lines, expected \d+ lines of 35 numbers"),
    ):
        program.write_text(f"#!/bin/sh\ncat > /dev/null\n{script}\n")
        program.chmod(0o755)
        with pytest.raises(InputError, match=message):
            check(golden, program)
    with pytest.raises(InputError, match="expected a program that runs"):
        check(golden, tmp_path / "none")
