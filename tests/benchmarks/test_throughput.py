"""The throughput benchmark's parts: C MuJoCo's rest against the solver, programs in turns, goals by hand."""

import json
import os
import sys

import numpy as np
import pytest

from benchmarks import gpu, rounds, throughput
from benchmarks.mujoco_arm import REST_S, Rest, SteppedArm, SteppedReach, Task
from benchmarks.mujoco_rollout import RolloutArms, RolloutReach, sensed_model
from benchmarks.rounds import Worker, WorkerError, take_turns, working
from benchmarks.throughput import over_rounds, points, side_by_side
from benchmarks.throughput_arms import compile_twice
from benchmarks.throughput_peers import Stepped, timed, write_arm
from benchmarks.truth import error_figures, random_references, true_rest
from mjx_softarm import ArmSpec
from mjx_softarm.env import EnvConfig, ReachEnv
from train.config import PRESETS, override

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
def reference():
    return random_references(SPEC, N)


@pytest.fixture(scope="module")
def truth(reference):
    return true_rest(SPEC, reference)


# --- C MuJoCo in time steps --------------------------------------------------------------------------------


def test_the_arm_stepped_in_time_rests_where_the_solver_says(model, reference, truth):
    arm = SteppedArm(model, Task(SPEC))
    tips_mm = []
    for row in reference:
        n_steps = arm.move(row)
        tips_mm.append(1e3 * arm.tip_m)
        assert n_steps * model.opt.timestep > REST_S
    assert truth.settled.all() and 0.2 < truth.share_at_limit < 0.8
    assert error_figures(np.array(tips_mm), truth)["max_mm"] < 1.5  # the springs may still creep by 0.1 mm


def test_a_stricter_rest_takes_longer_and_is_closer(model, reference, truth):
    found = []
    for rest_m in (1e-3, 1e-5):
        arm = SteppedArm(model, Task(SPEC), rest_m)
        found.append((arm.move(reference[0]), np.linalg.norm(1e3 * arm.tip_m - truth.tip_mm[0])))
    (fast_steps, fast_mm), (slow_steps, slow_mm) = found
    assert slow_steps > fast_steps and slow_mm < 0.2 < fast_mm


def test_the_rollout_rests_as_single_arms_do(model, reference, truth):
    arms = RolloutArms(model, SPEC, N, n_threads=2)
    end = arms.move(reference)
    arms.close()
    single = SteppedArm(model, Task(SPEC))
    total = 0
    for k in range(N):
        single.place(np.zeros(model.nq), np.zeros(9))
        total += single.move(reference[k])
        np.testing.assert_allclose(end.pose[k], single.pose, atol=0.02)
    assert abs(end.physics_steps - total) < 0.02 * total
    assert error_figures(end.pose[:, :3], truth)["max_mm"] < 1.5


def test_rest_is_when_no_spring_has_moved_for_long_enough():
    rest = Rest(2, SPEC, rest_m=1e-3)
    n_quiet = round(REST_S * SPEC.control.rate_hz)
    still, ticks = np.zeros(9), []
    for tick in range(3 * n_quiet):
        moving = np.where(np.arange(9) == 4, 1.1e-3 * min(tick, 10), 0.0)  # the second arm stops later
        ticks.append(rest.after(np.stack([still, moving])))
    first = np.argmax(np.array(ticks), axis=0)
    assert first[0] == n_quiet and first[1] == n_quiet + 10


def test_a_spring_that_swings_back_to_where_it_was_does_not_rest():
    rest = Rest(1, SPEC, rest_m=1e-3)
    period = round(REST_S * SPEC.control.rate_hz)
    swing = 2e-3 * np.sin(2 * np.pi * np.arange(4 * period) / period)
    assert not any(rest.after(np.full((1, 9), value))[0] for value in swing)


def test_the_peers_environments_are_the_project_s(folder, model):
    env = ReachEnv(SPEC, EnvConfig(n_poses=16))
    stepped = SteppedReach(str(folder), seed=0, episode_length=2)
    obs, _ = stepped.reset()
    rng = np.random.default_rng(0)
    action = rng.uniform(-1.0, 1.0, 9).astype(np.float32)
    np.testing.assert_allclose(stepped._task.reference_m(action), env.reference_m(action), atol=1e-6)
    after, value, terminated, truncated, info = stepped.step(action)
    pose, goal = stepped._arm.pose, stepped._goal
    np.testing.assert_allclose(obs[6:12], after[6:12])
    np.testing.assert_allclose(
        after, env.observe(pose.astype(np.float32), goal.astype(np.float32)), atol=1e-5
    )
    assert value == -100.0 and not terminated and not truncated  # a random action saturates
    assert info["physics_steps"] > 100 and 0.0 < info["stepping_s"] < 60.0
    np.testing.assert_allclose(info["tip_mm"], pose[:3])
    assert stepped.step(action)[3]  # its time is over


def test_an_arm_of_the_rollout_that_reached_its_goal_begins_anew(folder, model):
    with np.load(folder / "pool.npz") as stored:
        pool = {name: stored[name] for name in stored.files}
    arms = RolloutArms(model, SPEC, N, n_threads=1)
    envs = RolloutReach(arms, pool, episode_length=2)
    envs._goal[:] = pool["pose"][:N]
    task_action = ReachEnv(SPEC, EnvConfig(n_poses=16)).action_of(pool["spring_m"][:N].astype(np.float32))
    action = np.array(task_action)
    action[1] = 1.0  # the longest springs: not there
    _, value, *_ = envs.step(action)
    assert (value[[0, 2, 3]] == 100.0).all() and value[1] < 0.0
    np.testing.assert_array_equal(envs._n_taken, [0, 1, 0, 0])
    envs.step(action)
    assert envs._n_taken[1] == 0  # its time was over
    arms.close()


# --- programs in turns -------------------------------------------------------------------------------------

PROGRAM = """
import os, sys
from benchmarks.rounds import serve

def prepare():
    print("a library's chatter")
    os.system("echo chatter of another process")
    count = iter(range(100))
    cores = len(os.sched_getaffinity(0))
    return {"cores": cores}, lambda: {"n": next(count), "wanted": 1 / float(sys.argv[1])}

serve(prepare)
"""


def program(tmp_path, monkeypatch, argument, **kwargs):
    (tmp_path / "taking_turns.py").write_text(PROGRAM)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return Worker(f"turns of {argument}", ["taking_turns", argument], **kwargs)


def test_programs_take_turns_whatever_they_print(tmp_path, monkeypatch):
    first, second = (program(tmp_path, monkeypatch, x) for x in ("1", "2"))
    told, failed = take_turns([first, second], 2)
    assert failed == {} and told == {
        "turns of 1": [{"n": 0, "wanted": 1.0}, {"n": 1, "wanted": 1.0}],
        "turns of 2": [{"n": 0, "wanted": 0.5}, {"n": 1, "wanted": 0.5}],
    }


def test_a_program_keeps_to_its_cores_and_we_keep_ours(tmp_path, monkeypatch):
    before = os.sched_getaffinity(0)
    worker = program(tmp_path, monkeypatch, "1", n_cores=1)
    with working(worker):
        assert worker.facts == {"cores": 1}
    assert os.sched_getaffinity(0) == before


def test_a_program_that_stops_is_named_with_what_it_said(tmp_path, monkeypatch):
    worker = program(tmp_path, monkeypatch, "0")
    with (
        working(worker),
        pytest.raises(WorkerError, match=r"turns of 0: stopped with status 1(.|\n)*ZeroDiv") as caught,
    ):
        worker.round()
    assert caught.value.reason == (
        "turns of 0: stopped with status 1, expected a result: ZeroDivisionError: float division by zero"
    )


def test_a_program_that_fails_loses_no_other_s_rounds(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.rounds.ANSWER_S", 20.0)
    good, bad, none = (program(tmp_path, monkeypatch, x) for x in ("1", "0", "no number"))
    missing = Worker("missing", ["no_such_module"])
    told, failed = take_turns([bad, good, missing, none], 2)
    assert told == {"turns of 1": [{"n": 0, "wanted": 1.0}, {"n": 1, "wanted": 1.0}]}
    assert "ZeroDivisionError" in failed["turns of 0"] and "ValueError" in failed["turns of no number"]
    assert failed["missing"].endswith("No module named no_such_module")


def test_a_program_that_says_nothing_is_stopped(tmp_path, monkeypatch):
    (tmp_path / "silent.py").write_text("import time\ntime.sleep(600)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(rounds, "ANSWER_S", 0.5)
    told, failed = take_turns([Worker("silent", ["silent"])], 1)
    assert told == {}
    assert failed["silent"].startswith("silent: stopped with status -9 after 0.5 s in silence")


def test_a_point_that_fails_in_company_is_tried_alone_and_then_tells_why(monkeypatch):
    tried = []

    def made_up(workers, n_rounds):
        names = [worker.name.split(",")[0] for worker in workers]
        tried.append(names)
        failing = {w.name: f"{w.name}: no memory" for w in workers if "dynamic" in w.name}
        if len(workers) > 1:
            failing |= {w.name: "too many" for w in workers if w.name.startswith("mjx")}
        return {w.name: [{"env_steps_per_s": 7.0}] for w in workers if w.name not in failing}, failing

    monkeypatch.setattr(throughput, "take_turns", made_up)
    group = [("chain", "quasistatic", 8, 4), ("mjx", "quasistatic", 8, 4), ("mjx", "dynamic", 8, 4)]
    rows = throughput._group(group)
    assert tried == [["chain", "mjx", "mjx"], ["mjx"], ["mjx"]]
    assert [row.get("env_steps_per_s") for row in rows] == [7.0, 7.0, None]
    assert rows[2]["failed"] == "mjx, dynamic, 8 arms, 4 links: no memory"
    assert (rows[2]["engine"], rows[2]["mode"], rows[2]["arms"]) == ("mjx", "dynamic", 8)


def test_side_by_side_a_program_that_fails_has_a_row_that_says_why(monkeypatch):
    def made_up(workers, n_rounds):
        names = [worker.name for worker in workers]
        return {names[0]: [{"env_steps_per_s": 4670.0}]}, dict.fromkeys(names[1:], "no memory")

    monkeypatch.setattr(throughput, "take_turns", made_up)
    monkeypatch.setattr(throughput, "write_arm", lambda folder, spec: None)
    monkeypatch.setattr(throughput, "peer_python", lambda name: sys.executable)
    rows = throughput._side_by_side(SPEC, on_gpu=False)
    assert rows[0]["env_steps_per_s"] == 4670 and rows[0]["times_paper"] == 10.0
    assert [row["failed"] for row in rows] == [None, "no memory", "no memory", "no memory", None, None]
    assert rows[4]["skipped"] == gpu.NO_DEVICE


def test_a_start_that_fails_tells_why(monkeypatch):
    monkeypatch.setattr(throughput, "_START", "raise RuntimeError('not {cache} today')")
    assert throughput._start("here") == {"failed": "status 1: RuntimeError: not here today"}


def test_rates_are_medians_over_rounds_and_arrays_are_left_out():
    rounds = [
        {"env_steps_per_s": rate, "peak_rss_mb": rate + 1, "tip_mm": [[0.0]]}
        for rate in (300.0, 100.4, 200.0)
    ]
    assert over_rounds(rounds) == {"env_steps_per_s": 200, "peak_rss_mb": 201.0}
    assert over_rounds([{"env_steps_per_s": 5.678}]) == {"env_steps_per_s": 5.68}


def test_compiling_anew_and_from_the_cache_gives_a_function_that_computes():
    import jax

    compiled, facts = compile_twice(jax.jit(lambda x: 2 * x), 3.0)
    assert compiled(4.0) == 8.0
    assert facts.keys() == {"tracing_s", "compiling_s", "both_from_cache_s"}


def test_everything_asked_for_is_measured():
    cpu = [point for group in points(on_gpu=False) for point in group]
    assert len(set(cpu)) == len(cpu)
    for engine, mode in (("chain", "quasistatic"), ("mjx", "quasistatic"), ("mjx", "dynamic")):
        arms = {n for e, m, n, links in cpu if (e, m, links) == (engine, mode, 4)}
        assert {1, 1024} <= arms and max(arms) == 1024
        assert {2, 4, 10} <= {links for e, m, n, links in cpu if (e, m, n) == (engine, mode, 128)}
    assert {n for group in points(on_gpu=True) for *_, n, _ in group} >= {1, 8192, 32_768}


def test_rates_are_told_as_multiples_of_the_processes():
    rows = side_by_side(
        [
            {"program": "chain", "env_steps_per_s": 5000},
            {"program": "C MuJoCo, SubprocVecEnv, 2 processes", "env_steps_per_s": 50, "p95_mm": 0.5},
            {"program": "MJX-Warp", "skipped": "no device"},
        ]
    )
    assert [row["times_subproc"] for row in rows] == [100, 1.0, None, None]
    assert rows[2]["skipped"] == "no device" and rows[1]["p95_mm"] == 0.5
    assert rows[3]["env_steps_per_s"] == 467  # the paper's
    assert [row["times_paper"] for row in rows] == [10.71, 0.11, None, None]
    assert "lockstep" in rows[1]["note"] and rows[0]["note"] is None
    without = side_by_side([{"program": "chain", "env_steps_per_s": 5000}])
    assert without[0]["times_subproc"] is None


# --- goals of a GPU ----------------------------------------------------------------------------------------


def rates(chain, mjx):
    rows = [
        {"engine": "chain", "mode": "quasistatic", "arms": n, "env_steps_per_s": x} for n, x in chain.items()
    ]
    rows += [
        {"engine": "mjx", "mode": "quasistatic", "arms": n, "env_steps_per_s": x} for n, x in mjx.items()
    ]
    return [*rows, {"engine": "mjx", "mode": "dynamic", "arms": 1, "env_steps_per_s": 10**9}]


def test_goals_of_a_gpu_are_met_at_the_best_number_of_arms_or_not():
    goals = gpu.rate_goals(rates({1: 5, 8192: 300_000, 32_768: 7}, {8192: 29_999}), on_gpu=True)
    assert [row["verdict"] for row in goals] == ["met", "NOT MET"]
    assert goals[0]["measured"] == "300,000 with 8,192 arms"


def test_goals_of_a_gpu_are_skipped_without_one_and_say_why():
    goals = [*gpu.rate_goals(rates({1: 10**6}, {1: 10**6}), on_gpu=False), gpu.training_goal(on_gpu=False)]
    assert {row["verdict"] for row in goals} == {"skipped"}
    assert {row["measured"] for row in goals} == {gpu.NO_DEVICE}


def test_the_training_for_a_gpu_has_settings_that_there_are():
    config = override(PRESETS["quick"], list(gpu.TRAINING))
    assert config.n_arms == 2048 and config.n_updates_per_vector_step == 64


TRAINING = """
import json, sys, time
with open(sys.argv[1], "w", buffering=1) as file:
    for median in (9.0, None, 4.0, 2.5):
        file.write(json.dumps({"epoch": 1} if median is None else {"evaluation/median_mm": median}) + "\\n")
    file.write('{"evaluation/median_mm": 1')
    file.flush()
    time.sleep(float(sys.argv[2]))
sys.exit(int(sys.argv[3]))
"""


@pytest.mark.parametrize("median_mm, reached", [(3.0, True), (2.0, False)])
def test_time_to_a_median_is_read_from_the_metrics_of_a_run(tmp_path, median_mm, reached):
    metrics = tmp_path / "metrics.jsonl"
    sleep = "60" if reached else "0"  # stopped as soon as it is there
    command = [sys.executable, "-c", TRAINING, str(metrics), sleep, "0"]
    spent, best = gpu.seconds_to(median_mm, command, metrics, 30.0, {})
    assert (spent is not None) == reached and best == 2.5
    assert json.loads(metrics.read_text().splitlines()[0]) == {"evaluation/median_mm": 9.0}


def test_a_training_that_says_a_lot_is_not_stopped_by_it(tmp_path):
    loud = "import sys; sys.stderr.write('x' * 10**6)"
    command = [sys.executable, "-c", loud]
    assert gpu.seconds_to(1.0, command, tmp_path / "metrics.jsonl", 30.0, {}) == (None, float("inf"))


def test_a_training_that_fails_is_a_goal_that_is_not_met(tmp_path, monkeypatch):
    metrics = tmp_path / "metrics.jsonl"
    fails = [sys.executable, "-c", TRAINING, str(metrics), "0", "3"]
    with pytest.raises(RuntimeError, match="status 3"):
        gpu.seconds_to(1.0, fails, metrics, 30.0, {})
    given = []

    def fail(median_mm, command, metrics, longest_s, environment):
        given.append((metrics, environment))
        raise RuntimeError("train reach: status 1: a\nRESOURCE_EXHAUSTED: no memory")

    monkeypatch.setattr(gpu, "seconds_to", fail)
    row = gpu.training_goal(on_gpu=True)
    assert (row["measured"], row["verdict"]) == ("RESOURCE_EXHAUSTED: no memory", "NOT MET")
    ((metrics, environment),) = given
    assert environment["XDG_CACHE_HOME"] in str(metrics)  # new and empty, so compilation is in the time


STEPS = [
    Stepped(2, 400, 0.25, np.zeros((2, 9)), np.ones((2, 3))),
    Stepped(2, 200, 0.05, np.zeros((2, 9)), np.ones((2, 3))),
]


def test_what_an_environment_step_of_a_peer_is_made_of(monkeypatch):
    clock = iter([0.0, 0.0, 0.5, 1.0])
    monkeypatch.setattr("benchmarks.throughput_peers.time.perf_counter", lambda: next(clock))
    monkeypatch.setattr("benchmarks.throughput_peers.ROUND_S", 1.0)
    steps = iter(STEPS)
    told = timed(lambda: next(steps), timestep_s=0.002)
    assert (told["env_steps_per_s"], told["physics_steps_per_s"]) == (4.0, 600.0)
    assert (told["physics_steps_per_env_step"], told["simulated_s_per_env_step"]) == (150, 0.3)
    assert told["share_in_time_steps"] == 0.3 and np.shape(told["tip_mm"]) == (4, 3)
