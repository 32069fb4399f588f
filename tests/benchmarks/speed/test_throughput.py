"""The throughput benchmark: C MuJoCo's rest against the solver, rows of programs that take turns."""

import json
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.harness.peers import PeerError
from benchmarks.harness.rounds import ROOT
from benchmarks.speed import throughput
from benchmarks.speed.jax_worker import Program, rates
from benchmarks.speed.mujoco_arms import (
    REST_M,
    REST_S,
    RestDetector,
    SteppedArms,
    SteppedReach,
    SteppedReachGym,
    sensed_model,
    write_arm,
)
from benchmarks.speed.mujoco_worker import Step, timed
from benchmarks.speed.throughput import moving_row, over_rounds, side_by_side
from benchmarks.speed.truth import error_figures, random_references, reported_error, true_rest
from mjx_softarm import ArmSpec
from mjx_softarm.env import EnvConfig, ReachEnv

SPEC = ArmSpec.default()
N = 4


@pytest.fixture(scope="module")
def model():
    return sensed_model(SPEC)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm")
    write_arm(path, SPEC, n_poses=16)
    return path


@pytest.fixture(scope="module")
def env():
    return ReachEnv(SPEC, EnvConfig(n_poses=16))


@pytest.fixture(scope="module")
def reference():
    return random_references(SPEC, N)


@pytest.fixture(scope="module")
def truth(reference):
    return true_rest(SPEC, reference)


def test_arms_stepped_in_time_rest_where_the_solver_says_alone_and_in_company(model, reference, truth):
    arms = SteppedArms(model, SPEC, N, n_threads=2)
    end = arms.settle(reference)
    assert truth.settled.all() and 0.2 < truth.share_at_limit < 0.8
    assert error_figures(end.pose[:, :3], truth)["max_mm"] < 1.5  # the springs may still creep by 0.1 mm
    assert end.physics_steps * model.opt.timestep > N * REST_S
    alone = [SteppedArms(model, SPEC, 1, n_threads=0).settle(row[None]) for row in reference]
    np.testing.assert_allclose(end.pose, [one.pose[0] for one in alone], atol=0.02)
    assert end.physics_steps == pytest.approx(sum(one.physics_steps for one in alone), rel=0.02)


def test_the_error_of_what_programs_told_is_that_of_their_tips(reference, truth):
    off_mm = truth.tip_mm + [0, 0, 2]
    told = [{"reference_m": reference[k], "tip_mm": off_mm[k]} for k in (slice(0, 2), slice(2, 4))]
    assert reported_error(SPEC, [{"arms": 2}, *told])["median_mm"] == pytest.approx(2.0, abs=1e-3)
    assert reported_error(SPEC, [{"arms": 2}]) == {}


def test_an_arm_rests_when_no_spring_has_moved_for_long_enough():
    rest = RestDetector(2, SPEC)
    n_quiet = round(REST_S * SPEC.control.rate_hz)
    still, ticks = np.zeros(9), []
    for tick in range(3 * n_quiet):
        moving = np.where(np.arange(9) == 4, 1.1 * REST_M * min(tick, 10), 0.0)  # the second arm stops later
        ticks.append(rest.after(np.stack([still, moving]), slice(None)))
    first = np.argmax(np.array(ticks), axis=0)
    assert first[0] == n_quiet and first[1] == n_quiet + 10


def test_the_stepped_environment_is_the_project_s(folder, env):
    envs = SteppedReach(str(folder), 1, 0, 0, episode_length=2)
    obs = envs.reset(np.ones(1, bool))
    action = np.random.default_rng(0).uniform(-1.0, 1.0, 9).astype(np.float32)
    np.testing.assert_allclose(envs.reference_m(action), env.reference_m(action), atol=1e-6)
    after, value, reached, over, end = envs.step(action[None])
    np.testing.assert_allclose(obs[:, 6:12], after[:, 6:12])  # the goal
    pose, goal = (x[0].astype(np.float32) for x in (end.pose, envs.goal))
    np.testing.assert_allclose(after[0], env.observe(pose, goal), atol=1e-5)
    assert value == -100.0 and not reached and not over  # a random action saturates


def test_as_a_gymnasium_environment_it_tells_costs_and_where_it_stopped(folder):
    stepped, action = SteppedReachGym(str(folder), seed=0, episode_length=2), np.zeros(9, np.float32)
    obs, _ = stepped.reset()
    after, _, terminated, truncated, info = stepped.step(action)
    assert stepped.observation_space.contains(obs) and stepped.observation_space.contains(after)
    assert not terminated and not truncated and stepped.step(action)[3]
    assert info.keys() == set(Step._fields) and info["tip_mm"].shape == (3,)
    assert info["n_physics"] > 100


def test_arms_that_reach_their_goals_are_told_from_those_whose_time_is_over(folder, env):
    envs = SteppedReach(str(folder), N, 1, seed=0, episode_length=2)
    envs.reset(np.ones(N, bool))
    with np.load(folder / "pool.npz") as pool:
        envs.goal[:] = pool["pose"][:N]
        spring_m = pool["spring_m"][:N]
    action = np.array(env.action_of(spring_m.astype(np.float32)))
    action[1] = 1.0  # the longest springs: not at its goal
    _, value, reached, over, _ = envs.step(action)
    assert (value[[0, 2, 3]] == 100.0).all() and value[1] < 0.0
    assert reached.tolist() == [True, False, True, True] and not over.any()
    envs.reset(reached | over)
    assert envs.step(action)[3].tolist() == [False, True, False, False]


def test_the_stepped_arms_need_no_jax():
    check = "import sys, benchmarks.speed.mujoco_arms; sys.exit('jax' in sys.modules)"
    subprocess.run([sys.executable, "-c", check], cwd=ROOT, check=True)


def test_rates_are_medians_over_rounds_and_arrays_are_left_out():
    rounds = [
        {"env_steps_per_s": rate, "unsettled": int(rate), "tip_mm": [[0.0]]} for rate in (300.0, 100.4, 200.0)
    ]
    assert over_rounds(rounds) == {"env_steps_per_s": 200, "unsettled": 200}
    assert over_rounds([{"env_steps_per_s": 5.678}]) == {"env_steps_per_s": 5.68}


def test_programs_beside_others_have_a_row_each_or_a_reason(monkeypatch):
    asked = []

    def take_turns(workers, n_rounds):
        asked.append([worker.name for worker in workers])
        told = [{"env_steps_per_s": rate} for rate in (100.0, 300.0, 200.0)]
        return {worker.name: told for worker in workers[:-1]}, {workers[-1].name: "no memory"}

    def peer_python(library):
        raise PeerError(f"{library}: no network")

    monkeypatch.setattr(throughput, "take_turns", take_turns)
    monkeypatch.setattr(throughput, "peer_python", peer_python)
    monkeypatch.setattr(throughput, "write_arm", lambda *_: None)
    figures = throughput.beside_peers()
    assert figures["side_by_side"][0]["env_steps_per_s"] == 200
    assert [row.get("failed") for row in figures["side_by_side"][:3]] == [None, None, "no memory"]
    assert figures["side_by_side"][-2]["skipped"] == "sb3-contrib: no network"
    assert [row["skipped"] for row in figures["simulated_time"][2:]] == ["soromox: no network"] * 2
    at_rest = asked[0][:2]
    assert at_rest == ["mjx, quasistatic, 1024 arms", "chain, quasistatic, 1024 arms"]  # equals


def test_rates_are_multiples_of_c_mujoco_s_in_threads_and_in_processes_beside_the_paper_s():
    rows = side_by_side(
        [
            {"program": "chain", "env_steps_per_s": 5000},
            {"program": "C MuJoCo, SubprocVecEnv, 2 processes", "env_steps_per_s": 50, "p95_mm": 0.5},
            {"program": "C MuJoCo, rollout, 2 threads", "env_steps_per_s": 100},
            {"program": "absent", "skipped": "no device"},
        ]
    )
    assert [row.get("times_subproc") for row in rows] == [100, 1.0, 2.0, None, None]
    assert [row.get("times_rollout") for row in rows] == [50, 0.5, 1.0, None, None]
    assert rows[3]["skipped"] == "no device" and rows[1]["p95_mm"] == 0.5
    assert rows[4]["env_steps_per_s"] == 467  # the paper's
    assert side_by_side([{"program": "chain", "env_steps_per_s": 5000}])[0]["times_subproc"] is None


def test_rates_leave_out_the_first_call_unless_it_is_long(monkeypatch):
    clock = iter([0.0, 0.4, 0.9, 1.4, 0.0, 3.0])
    monkeypatch.setattr("benchmarks.speed.jax_worker.time.perf_counter", lambda: next(clock))
    program = Program(0.0, lambda: np.zeros(1), n_env_steps=100, n_updates=5)
    assert rates(program, 1.0) == {"env_steps_per_s": pytest.approx(200), "updates_per_s": pytest.approx(10)}
    assert rates(program, 1.0)["env_steps_per_s"] == pytest.approx(100 / 3)


@pytest.mark.parametrize(
    "options", [["--engine", "chain", "--mode", "quasistatic"], ["--train", "--engine", "chain"]]
)
def test_a_table_of_this_machine_and_its_file(options, tmp_path, capsys, monkeypatch):
    def program(*_):
        return Program(1.5, lambda: np.zeros(1), 1_000_000, 10 * ("--train" in options))

    for name in ("rollout", "training", "gradient_steps"):
        monkeypatch.setattr(throughput, name, program)
    monkeypatch.setattr(
        throughput, "rates", lambda program, s: {"env_steps_per_s": 2e4, "updates_per_s": 300.0}
    )
    monkeypatch.setattr(throughput.jax.config, "update", lambda *_: None)
    monkeypatch.setattr(throughput.xla, "enable_compilation_cache", lambda: None)
    monkeypatch.setattr(throughput, "n_cores", lambda: 1)
    file = tmp_path / "speed.json"
    assert main(["throughput", "--arms", "8", "16", "--seconds", "0.01", "--json", str(file), *options]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[1][:5] == ["engine", "mode", "arms", "compile", "[s]"]
    assert ["chain", "quasistatic", "8", "1.5", "20,000", "300"] in lines
    written = json.loads(file.read_text())
    assert [(row["arms"], row["compile_s"]) for row in written["rows"]] == [(8, 1.5), (16, 1.5)]
    assert written["train"] == ("--train" in options) and "commit" in written


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--arms", "0"], "--arms: got 0, expected numbers from 1"),
        (["--devices", "0"], "--devices: got 0, expected a number from 1"),
        (["--engine", "fem"], "--engine: got fem, expected some of mjx, chain, mjx-step, warp"),
        (["--mode", "rest"], "--mode: got rest, expected some of quasistatic, dynamic"),
        (
            ["--engine", "chain", "--mode", "dynamic"],
            "--engine: got chain with --mode dynamic, expected mjx,",
        ),
        (["--seconds", "0"], "--seconds: got 0, expected a finite number > 0"),
        (["--json", "absent/speed.json"], "--json: got absent/speed.json, expected a file in a folder that"),
        (["--peers", "--train"], "--peers: got other options too, expected --json at most"),
    ],
)
def test_misuse_is_a_line(options, message, capsys):
    assert main(["throughput", *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


@pytest.mark.parametrize("train", [False, True])
def test_a_program_of_each_kind_runs(train):
    row = throughput.row_of(throughput.Point("chain", "quasistatic", 8), 1, 0.1, train)
    assert row["env_steps_per_s"] > 0 and row["compile_s"] > 0.1 and ("updates_per_s" in row) == train


def test_a_round_of_steps_has_its_rate_and_the_simulated_time_of_a_step(monkeypatch):
    clock = iter([0.0, 0.0, 0.5, 1.0])
    monkeypatch.setattr("benchmarks.speed.mujoco_worker.time.perf_counter", lambda: next(clock))
    monkeypatch.setattr("benchmarks.speed.mujoco_worker.ROUND_S", 1.0)
    steps = iter(Step(n, np.zeros((2, 9)), np.ones((2, 3))) for n in (400, 200))
    told = timed(lambda: next(steps), timestep_s=0.002)
    assert (told["env_steps_per_s"], told["simulated_s_per_env_step"]) == (4.0, 0.3)
    assert told["simulated_s_per_s"] == pytest.approx(1.2)
    assert np.shape(told["tip_mm"]) == (4, 3)


def test_programs_in_motion_are_told_by_simulated_seconds_and_this_project_s_by_the_time_of_a_step():
    ours = moving_row({"program": "mjx", "env_steps_per_s": 1000, "failed": None})
    peer = moving_row({"program": "peer", "step_ms": 0.75, "arms": 8, "simulated_s_per_s": 20.5})
    c = moving_row(
        {"program": "C", "step_ms": 5.0, "arms": 64, "env_steps_per_s": 40, "simulated_s_per_s": 160}
    )
    missing = moving_row({"program": "absent", "skipped": "no network"})
    assert [row["simulated_s_per_s"] for row in (ours, peer, c)] == [500, 20.5, 160]
    assert (ours["step_ms"], ours["arms"]) == (20.0, 128) and (c["step_ms"], c["arms"]) == (5.0, 64)
    assert missing == {"program": "absent", "skipped": "no network"}
