"""The race: curves with known crossings, when to stop and to go on, goals; with a made-up program."""

import json
import sys

import jax
import numpy as np
import pytest

from benchmarks import race
from benchmarks.race import RaceError, Settings, claim, run, train
from benchmarks.race_contestants import (
    Contestant,
    HeldOut,
    prepare,
    scaled,
    tuned_settings,
)
from benchmarks.race_summary import crossing, judge, summarise
from benchmarks.rounds import Worker, WorkerError
from mjx_softarm.env import EnvConfig, ReachEnv
from train.config import PRESETS
from train.evaluate import Evaluator
from train.tqc import TQC

FAKE = '''
"""A contestant whose curve is known: 100 mm / round, 10 s and 1,000 env steps each; or it stops by itself."""
import sys
from benchmarks.rounds import serve
name, seed, stretch_s, n_goals = sys.argv[1:]
k = 0
def work():
    global k
    k += 1
    if "broken" in name and k == 2:
        raise RuntimeError("not today")
    return {"wall_s": 3 + 10.0 * k, "trained_s": 10.0 * k, "env_steps": 1000 * k, "updates": k,
            "median_mm": 100 / k, "ended": k == 30}
serve(lambda: ({"start_up_s": 3.0}, work))
'''


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """A function: name -> a worker that is not started."""
    (tmp_path / "fake_contestant.py").write_text(FAKE, "utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return lambda name="fake": Worker(name, ["fake_contestant", name, "0", "1.0", "8"])


def curve(*errors_mm):
    """A point each 10 s."""
    return [
        {
            "wall_s": 2.0 + 10 * k,
            "trained_s": 10.0 * k,
            "env_steps": 100 * k,
            "updates": k,
            "median_mm": error_mm,
        }
        for k, error_mm in enumerate(errors_mm, 1)
    ]


def result(name, *errors_mm, seed=0):
    return {
        "contestant": name,
        "seed": seed,
        "start_up_s": 2.0,
        "limit_s": None,
        "points": curve(*errors_mm),
    }


# --- curves ------------------------------------------------------------------------------------------------


def test_a_level_is_reached_where_the_line_between_two_evaluations_crosses_it_first():
    points = curve(20.0, 12.0, 8.0, 11.0, 4.0)
    assert crossing(points, 10, "wall_s") == pytest.approx(27.0)  # half way from 22 to 32
    assert crossing(points, 8, "trained_s") == pytest.approx(30.0)
    assert crossing(points, 5, "env_steps") == pytest.approx(400 + 100 * 6 / 7)
    assert crossing(points, 3, "wall_s") is None


def test_a_curve_that_begins_below_a_level_has_it_at_its_first_evaluation():
    assert crossing(curve(4.0, 3.0), 5, "wall_s") == 12.0


def test_errors_that_are_not_finite_reach_nothing():
    assert crossing(curve(None, None), 10, "wall_s") is None
    assert crossing(curve(20.0, None, 4.0), 5, "wall_s") == 32.0  # nothing to draw the line from


# --- goals -------------------------------------------------------------------------------------------------


def others(*errors_mm):
    """Both variants of both peers, which need as long as the curve says."""
    names = ("sbx-tuned", "sbx-defaults", "sb3-contrib-tuned", "sb3-contrib-defaults")
    return [result(name, *errors_mm) for name in names]


def test_a_goal_is_met_by_the_better_variant_s_time_over_ours():
    ours = result("ours", 6.0, 4.0)  # 5 mm at 17 s
    slow = [9.0] * 8
    results = [ours, result("sbx-tuned", *slow, 6.0, 4.0), result("sbx-defaults", *slow, 9.0, 9.0, 9.0)]
    row = judge("sbx", results)  # 97 s against 17 s
    assert (row["measured"], row["verdict"]) == ("5.71 times", "met")
    assert "5 mm" in row["goal"] and "at least 5 times" in row["goal"]
    results[2] = result("sbx-defaults", 9.0, 9.0, 6.0, 4.0)  # 37 s
    assert judge("sbx", results)["measured"] == "2.18 times"
    assert judge("sbx", results)["verdict"] == "NOT MET"


def test_a_peer_that_was_stopped_counts_with_the_time_that_it_had():
    row = judge("sbx", [result("ours", 4.0), *others(*[9.0] * 6)])  # 62 s against 12 s
    assert (row["measured"], row["verdict"]) == ("not within 5.17 times", "met")
    row = judge("sb3-contrib", [result("ours", 4.0), *others(*[9.0] * 6)])
    assert (row["measured"], row["verdict"]) == ("not within 5.17 times", "NOT MET")


def test_a_goal_that_ours_does_not_reach_is_not_met():
    row = judge("sbx", [result("ours", 6.0), *others(*[9.0] * 60)])
    assert row["verdict"] == "NOT MET" and "ours did not reach it with seed 0" in row["measured"]


def test_a_goal_is_skipped_where_a_variant_failed_and_says_why():
    results = [result("ours", 4.0), *others(*[9.0] * 60)]
    results[1] = {"contestant": "sbx-tuned", "seed": 0, "failed": "no network"}
    assert judge("sbx", results)["verdict"] == "skipped"
    assert judge("sbx", results)["measured"] == "sbx-tuned: no network"
    assert judge("sb3-contrib", results)["verdict"] == "met"
    assert summarise(results)["failed"] == [results[1]]


def test_the_median_over_seeds_is_what_counts():
    times = {0: 6, 1: 3, 2: 7}  # evaluations until 4 mm
    results = [result("ours", 4.0, seed=seed) for seed in times]
    for seed, n in times.items():
        results += [result(f"sbx-{v}", *[9.0] * n, 4.0, seed=seed) for v in ("tuned", "defaults")]
    assert judge("sbx", results)["measured"] == "5.83 times"  # (2 + 68) / 12 of seed 0, at 4/5 of its last


def test_tables_have_a_row_for_each_contestant_with_start_up_and_without():
    figures = summarise([result("ours", 12.0, 8.0, 4.0), *others(20.0)])
    assert figures["wall_s"][0] == {
        "contestant": "ours",
        "seed": 0,
        "start_up": 2.0,
        "to_10_mm": 17.0,
        "to_5_mm": 29.5,
        "to_3_mm": "not within 32",
        "to_2_mm": "not within 32",
        "best_mm": 4.0,
        "in_all": 32,
    }
    assert figures["wall_s_without_start_up"][0]["to_10_mm"] == 15.0
    assert figures["env_steps"][0]["to_5_mm"] == 275.0
    assert [row["to_10_mm"] for row in figures["wall_s"][1:]] == ["not within 12"] * 4
    json.dumps(figures, allow_nan=False)


# --- a contestant and its process --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "limits, n_points",
    [
        ({"limit_s": 93.0, "target_mm": 0.0}, 9),  # 3 + 10 k >= 93
        ({"limit_s": 1e9, "target_mm": 20.0}, 5),  # 100 / k <= 20
        ({"limit_s": float("inf"), "target_mm": 0.0}, 30),  # ended
    ],
)
def test_a_contestant_trains_until_its_limit_its_target_or_its_end(fake, limits, n_points):
    found = train(fake(), **limits, n_points=1000)
    assert [point["updates"] for point in found["points"]] == list(range(1, n_points + 1))
    assert found["start_up_s"] == 3.0 and "ended" not in found["points"][-1]
    json.dumps(found, allow_nan=False)


def test_a_contestant_that_stops_by_itself_is_told_with_its_last_words(fake):
    with pytest.raises(WorkerError, match=r"(?s)broken: stopped with status 1.*RuntimeError: not today"):
        train(fake("broken"), 100.0, 0.0, 10)


def test_time_counts_in_training_and_stands_while_the_policy_is_evaluated(monkeypatch):
    clock = [0.0]
    steps = [0]
    monkeypatch.setattr("benchmarks.race_contestants.time.perf_counter", lambda: clock[0])

    class Slow:
        def __init__(self, env, n_goals):
            assert n_goals == 8
            clock[0] += 1000

        def tip_error_mm(self, policy):
            clock[0] += 100
            return np.array([1.0, 2.0, 9.0])

    monkeypatch.setattr("benchmarks.race_contestants.HeldOut", Slow)
    monkeypatch.setattr("mjx_softarm.env.ReachEnv", lambda: None)

    def stretch():
        clock[0] += 2.0
        steps[0] += 10

    contestant = Contestant(stretch, lambda obs: obs, lambda: (steps[0], 7), limit=60)
    facts, work = prepare(contestant, 5.0, 3.0, 8)
    assert facts == {"start_up_s": 5.0}
    assert work() == {
        "wall_s": 9.0,
        "trained_s": 4.0,
        "env_steps": 20,
        "updates": 7,
        "median_mm": 2.0,
        "ended": False,
    }
    clock[0] += 1000  # nor while nobody asks
    assert (work()["wall_s"], work()["ended"]) == (13.0, True)


def test_held_out_goals_are_evaluated_as_the_trainer_does_it():
    env = ReachEnv(config=EnvConfig(n_poses=16))
    agent = TQC(env.observation_size, env.action_size)
    params = agent.init(jax.random.PRNGKey(3)).actor_params
    evaluator = Evaluator(env, agent, n_goals=12)
    reached = evaluator._workspace(params, evaluator.goals)
    found = HeldOut(env, 12).tip_error_mm(lambda obs: np.asarray(agent.act_mode(params, obs)))
    assert np.ptp(found) > 10.0
    np.testing.assert_allclose(found, reached.tip_error_mm, atol=0.01)


def test_tuned_peers_have_the_quick_preset_s_settings():
    n_steps = [0]
    settings = tuned_settings(PRESETS["quick"], lambda: n_steps[0])
    rate = settings.pop("learning_rate")
    assert settings == {
        "buffer_size": 400_000,
        "learning_starts": 2048,
        "batch_size": 256,
        "tau": 0.005,
        "gamma": 0.5,
        "train_freq": 1,
        "gradient_steps": 128,
        "ent_coef": "auto_0.1",
        "target_entropy": -30.0,
    }
    for n_steps[0], expected in (
        (0, 1e-3),
        (20_000, 0.51e-3),
        (39_999, 0.02e-3),
        (40_000, 1e-3),
        (60_000, 0.51e-3),
    ):
        assert rate(1.0) == pytest.approx(expected, rel=1e-3)


def test_rewards_are_scaled_and_nothing_else():
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env", reason="stable-baselines3 is not here")
    import gymnasium

    envs = vec_env.DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")] * 2)
    envs.seed(0)
    first, action = envs.reset(), np.zeros((2, 1))
    obs, rewards, *_ = envs.step(action)
    envs.seed(0)
    again = scaled(envs, 0.1)
    np.testing.assert_array_equal(again.reset(), first)
    same, tenth, *_ = again.step(action)
    np.testing.assert_array_equal(same, obs)
    np.testing.assert_allclose(tenth, 0.1 * rewards, rtol=1e-6)


# --- the folder --------------------------------------------------------------------------------------------


@pytest.fixture
def asked(monkeypatch):
    """What each contestant was asked, in place of training it."""
    asked = {}

    def made_up(worker, limit_s, target_mm, n_points):
        asked[worker.name] = (limit_s, target_mm)
        if worker.name.startswith("sbx-tuned"):
            raise WorkerError("sbx-tuned: not today")
        return {
            key: value
            for key, value in result("", 12.0, 8.0, 4.0).items()
            if key not in ("contestant", "seed")
        }

    monkeypatch.setattr(race, "train", made_up)
    monkeypatch.setattr(race, "peer_python", lambda name: sys.executable)
    return asked


def test_peers_get_our_time_to_5_mm_as_often_as_the_goal_asks_and_stop_where_ours_did(asked, tmp_path):
    results = run(tmp_path, (4,), Settings())
    assert asked == {
        "ours, seed 4": (float("inf"), 0.0),
        "sbx-tuned, seed 4": (5 * 29.5, 5),
        "sbx-defaults, seed 4": (5 * 29.5, 5),
        "sb3-contrib-tuned, seed 4": (15 * 29.5, 5),
        "sb3-contrib-defaults, seed 4": (15 * 29.5, 5),
    }
    assert [one["contestant"] for one in results if "failed" in one] == ["sbx-tuned"]


def test_what_was_measured_is_not_measured_again_but_what_failed_is(asked, tmp_path):
    before = run(tmp_path, (0,), Settings())
    asked.clear()
    assert run(tmp_path, (0,), Settings()) == before
    assert list(asked) == ["sbx-tuned, seed 0"]
    asked.clear()
    run(tmp_path, (0, 1), Settings())
    assert len(asked) == 1 + 5


def test_a_folder_of_another_commit_or_size_is_refused(monkeypatch, tmp_path):
    made = {"commit": "a", "machine": {"cpus": 2}, "command": "this", "uncommitted_changes": False}
    monkeypatch.setattr(race, "provenance", lambda program: dict(made))
    claim(tmp_path / "race", Settings())
    made |= {"command": "that", "uncommitted_changes": True}
    claim(tmp_path / "race", Settings())
    made["commit"] = "b"
    with pytest.raises(
        RaceError, match=r"settings.json: was made with commit a, now b; choose another --out"
    ):
        claim(tmp_path / "race", Settings())
    made["commit"] = "a"
    with pytest.raises(RaceError, match=r"n_goals 2000, now 8"):
        claim(tmp_path / "race", Settings(n_goals=8))


def test_ours_failing_ends_the_race(monkeypatch, tmp_path, capsys):
    def fail(*_):
        raise WorkerError("ours, seed 0: stopped with status 1")

    monkeypatch.setattr(race, "train", fail)
    assert race.main(["--smoke", "--out", str(tmp_path)]) == 2
    assert "error: ours, seed 0: stopped with status 1" in capsys.readouterr().err
    assert not list(tmp_path.glob("*seed0.json"))


@pytest.mark.parametrize("seeds", ["", "1,", "-1", "a"])
def test_seeds_are_numbers(seeds, capsys):
    with pytest.raises(SystemExit):
        race.main([f"--seeds={seeds}"])
    assert "expected integers >= 0" in capsys.readouterr().err
