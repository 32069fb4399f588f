"""The throughput benchmark's parts: C MuJoCo's rest against the solver, rows of programs that take turns."""

import sys

import numpy as np
import pytest

from benchmarks.speed import gpu, throughput
from benchmarks.speed.mujoco_arm import REST_S, Rest, SteppedArm, SteppedReach, Task
from benchmarks.speed.mujoco_rollout import RolloutArms, RolloutReach, sensed_model
from benchmarks.speed.throughput import over_rounds, points, side_by_side
from benchmarks.speed.throughput_arms import compile_twice
from benchmarks.speed.throughput_peers import Stepped, timed, write_arm
from benchmarks.speed.truth import error_figures, random_references, true_rest
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


# --- programs side by side ---------------------------------------------------------------------------------


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
        measured = {links for e, m, n, links in cpu if (e, m, n) == (engine, mode, 128)}
        assert measured == ({2, 4, 6, 8, 10} if engine == "chain" else {2, 4, 6})
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


STEPS = [
    Stepped(2, 400, 0.25, np.zeros((2, 9)), np.ones((2, 3))),
    Stepped(2, 200, 0.05, np.zeros((2, 9)), np.ones((2, 3))),
]


def test_what_an_environment_step_of_a_peer_is_made_of(monkeypatch):
    clock = iter([0.0, 0.0, 0.5, 1.0])
    monkeypatch.setattr("benchmarks.speed.throughput_peers.time.perf_counter", lambda: next(clock))
    monkeypatch.setattr("benchmarks.speed.throughput_peers.ROUND_S", 1.0)
    steps = iter(STEPS)
    told = timed(lambda: next(steps), timestep_s=0.002)
    assert (told["env_steps_per_s"], told["physics_steps_per_s"]) == (4.0, 600.0)
    assert (told["physics_steps_per_env_step"], told["simulated_s_per_env_step"]) == (150, 0.3)
    assert told["share_in_time_steps"] == 0.3 and np.shape(told["tip_mm"]) == (4, 3)
