"""The throughput benchmark: C MuJoCo's rest against the solver, rows of programs that take turns."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.harness.rounds import ROOT
from benchmarks.speed import jax_worker, throughput
from benchmarks.speed.jax_worker import Program, rates
from benchmarks.speed.mujoco_arms import REST_S, SteppedArms, SteppedEnv
from benchmarks.speed.truth import error_figures, random_references, reported_error, true_rest
from mjx_softarm import ArmSpec
from mjx_softarm._support.errors import InputError

SPEC = ArmSpec.default()
N = 4


@pytest.fixture(scope="module")
def reference():
    return random_references(SPEC, N)


@pytest.fixture(scope="module")
def truth(reference):
    return true_rest(SPEC, reference)


def test_arms_stepped_in_time_rest_where_the_solver_says_alone_and_in_company(reference, truth):
    arms = SteppedArms(SPEC, N, n_threads=2)
    end = arms.settle(reference)
    assert truth.settled.all() and 0.2 < truth.share_at_limit < 0.8
    assert error_figures(1e3 * end.tip_m, truth)["max_mm"] < 1.5  # the springs may still creep by 0.1 mm
    assert end.physics_steps * arms.timestep_s > N * REST_S
    alone = [SteppedArms(SPEC, 1, n_threads=0).settle(row[None]) for row in reference]
    np.testing.assert_allclose(end.tip_m, [one.tip_m[0] for one in alone], atol=2e-5)
    assert end.physics_steps == pytest.approx(sum(one.physics_steps for one in alone), rel=0.02)
    tip_m, *_, info = SteppedEnv().step(reference[0])
    np.testing.assert_allclose(tip_m, alone[0].tip_m[0], atol=1e-6)
    assert info["n_physics"] == alone[0].physics_steps


def test_the_error_of_a_worker_s_answers_is_that_of_their_tips(reference, truth):
    off_mm = truth.tip_mm + [0, 0, 2]
    answers = [{"reference_m": reference[k], "tip_mm": off_mm[k]} for k in (slice(0, 2), slice(2, 4))]
    assert reported_error(SPEC, [{"arms": 2}, *answers])["median_mm"] == pytest.approx(2.0, abs=1e-3)
    assert reported_error(SPEC, [{"arms": 2}]) == {}


def test_programs_beside_others_have_a_row_each_or_a_reason(monkeypatch):
    def take_turns(workers, n_rounds):
        answers = [{"env_steps_per_s": rate} for rate in (100.0, 5.678, 200.4)]
        for worker in workers:
            worker.facts = {"arms": 8, "reference_m": []}
        return {worker.name: answers for worker in workers[:-1]}, {workers[-1].name: "no memory"}

    def peer_python(library):
        raise InputError(f"{library}: no network")

    monkeypatch.setattr(throughput, "take_turns", take_turns)
    monkeypatch.setattr(throughput, "peer_python", peer_python)
    figures = throughput.beside_peers()
    at_rest = {row.pop("program"): row for row in figures["at_rest"]}
    assert at_rest["mjx"] == at_rest["chain"] == {"arms": 8, "env_steps_per_s": 100}
    assert at_rest["C MuJoCo, rollout"] == {"failed": "no memory"}
    assert at_rest["C MuJoCo, SubprocVecEnv"] == {"failed": "sb3-contrib: no network"}
    failed = [row["failed"] for row in figures["in_motion"] if "failed" in row]
    assert failed == ["soromox: no network"] * 2 + ["no memory"]


def test_rates_leave_out_the_first_call_unless_it_is_long(monkeypatch):
    clock = iter([0.0, 0.4, 0.9, 1.4, 0.0, 3.0])
    monkeypatch.setattr(jax_worker.time, "perf_counter", lambda: next(clock))
    program = Program(0.0, lambda: np.zeros(1), n_env_steps=100, n_updates=5)
    assert rates(program, 1.0) == {"env_steps_per_s": pytest.approx(200), "updates_per_s": pytest.approx(10)}
    assert rates(program, 1.0)["env_steps_per_s"] == pytest.approx(100 / 3)


@pytest.mark.parametrize("train", [False, True])
def test_smoke(train, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(throughput, "split_cpu", lambda: None)  # JAX has been used: no more devices
    file, options = tmp_path / "speed.json", ["--train"] * train
    words = ["--arms", "8", "--engine", "chain", "--mode", "quasistatic", "--seconds", "0.1"]
    assert main(["throughput", *words, "--json", str(file), *options]) == 0
    written = json.loads(file.read_text())
    (row,) = written["rows"]
    assert (row["engine"], row["arms"], written["train"]) == ("chain", 8, train) and "commit" in written
    assert row["env_steps_per_s"] > 0 and row["compile_s"] > 0 and ("updates_per_s" in row) == train
    assert capsys.readouterr().out.splitlines()[2].split()[:3] == ["chain", "quasistatic", "8"]


ON_TWO = """
import sys
from benchmarks.__main__ import main
from benchmarks.speed import throughput
measured = throughput.rates

def rates(program, seconds):
    print("tips on", sorted(device.id for device in program.call()[-1].sharding.device_set))
    return measured(program, seconds)

throughput.rates = rates
sys.exit(main(["throughput", "--devices", "2", *sys.argv[1:]]))
"""


@pytest.mark.parametrize(("n_arms", "status"), [("4", 0), ("3", 2)])
def test_devices_share_the_arms(n_arms, status, tmp_path):
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    words = ["--engine", "chain", "--mode", "quasistatic", "--seconds", "0.1", "--json", tmp_path / "a.json"]
    command = [sys.executable, "-c", ON_TWO, "--arms", n_arms, *words]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == status, done.stderr
    if status:
        assert done.stderr == "error: --arms: got 3, expected a multiple of 2 devices\n"
    else:
        assert "tips on [0, 1]\n" in done.stdout
        assert json.loads((tmp_path / "a.json").read_text())["devices"] == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--arms", "0"], "--arms: got 0"),
        (["--engine", "chain", "--mode", "dynamic"], "--engine: got chain"),
        (["--json", "absent/speed.json"], "expected a file in a folder"),
        (["--devices", "0"], "--devices: got 0, expected 1 to "),
        (["--devices", "1000"], "--devices: got 1000, expected 1 to "),
        (["--train", "--devices", "2"], "--devices: got 2, expected 1 with --train"),
        (["--peers", "--train"], "--peers: got other options too"),
    ],
)
def test_misuse_is_a_line(options, message, capsys):
    assert main(["throughput", *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
