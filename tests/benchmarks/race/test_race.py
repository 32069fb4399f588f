"""The race: contestants and their processes, what each is given, what is kept; with a made-up program."""

import json
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.harness.peers import PINS
from benchmarks.harness.rounds import Worker, WorkerError
from benchmarks.race import race
from benchmarks.race.contestants import CONTESTANTS, Contestant, HeldOut, prepare, settings_of
from benchmarks.race.race import RaceError, RaceLimits, limits_of, run, train
from benchmarks.race.threads import choose_threads
from mjx_softarm._support import xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.mechanics.workspace import HELD_OUT_SEED
from tests.train.small import SHORT
from train.agent.tqc import TQC
from train.presets import PRESETS
from train.runs import evaluate

FAKE = '''
"""A contestant whose curve is known: 100 mm / round, 10 s and 1,000 env steps each; or it stops by itself."""
import sys
from benchmarks.__main__ import main
from benchmarks.harness.rounds import serve
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


@pytest.mark.parametrize(
    "limits, n_points",
    [
        (RaceLimits(93.0), 9),  # 3 + 10 k >= 93
        (RaceLimits(target_mm=20.0), 5),  # 100 / k <= 20
        (RaceLimits(), 30),  # ended
    ],
)
def test_a_contestant_trains_until_its_limit_its_target_or_its_end(fake, limits, n_points):
    found = train(fake(), limits)
    assert [point["updates"] for point in found["points"]] == list(range(1, n_points + 1))
    assert found["start_up_s"] == 3.0 and "ended" not in found["points"][-1]
    json.dumps(found, allow_nan=False)


def test_time_counts_in_training_and_stands_while_the_policy_is_evaluated(monkeypatch):
    clock, steps = [0.0], [0]

    class Slow:
        def __init__(self, env, n_goals):
            assert n_goals == 8
            clock[0] += 1000

        def tip_error_mm(self, policy):
            clock[0] += 100
            return np.array([1.0, 2.0, 9.0])

    def stretch():
        clock[0] += 2.0
        steps[0] += 10

    monkeypatch.setattr("benchmarks.race.contestants.time.perf_counter", lambda: clock[0])
    monkeypatch.setattr("benchmarks.race.contestants.HeldOut", Slow)
    monkeypatch.setattr("mjx_softarm.env.ReachEnv", lambda: None)
    contestant = Contestant(stretch, lambda obs: obs, lambda: (steps[0], 7), limit=60)
    facts, work = prepare(contestant, 5.0, 3.0, 8)
    assert facts == {"start_up_s": 5.0}
    expected = {"wall_s": 9.0, "trained_s": 4.0, "env_steps": 20, "updates": 7, "median_mm": 2.0}
    assert work() == expected | {"ended": False}
    clock[0] += 1000  # nor while nobody asks
    assert (work()["wall_s"], work()["ended"]) == (13.0, True)


def test_held_out_goals_are_evaluated_as_the_trainer_does_it(quick_compiler, monkeypatch):
    monkeypatch.setattr(evaluate, "PATH", 6)
    env = ReachEnv(SHORT, EnvConfig(n_poses=16))
    agent = TQC(env.observation_size, env.action_size)
    params = agent.init(jax.random.PRNGKey(3)).actor_params
    held_out = HeldOut(env, 12)
    found = held_out.tip_error_mm(lambda obs: np.asarray(agent.mode(params, obs)))
    paths = evaluate.paths_of(env.sample_pool(12, HELD_OUT_SEED).pose)
    follow = jax.vmap(evaluate.follower(env, agent, N_ACTIONS), in_axes=(None, 0, 0))
    reached = xla.jit(follow)(params, paths, evaluate.start_keys(2))
    assert np.ptp(found) > 10.0
    expected = np.linalg.norm((reached.pose - reached.goal)[..., :3], axis=-1)
    np.testing.assert_allclose(found, expected.reshape(-1), atol=0.01)


def test_peers_have_the_quick_preset_s_settings():
    n_steps, config = [0], PRESETS["quick"].learner
    settings = settings_of(config, lambda: n_steps[0])
    rate = settings.pop("learning_rate")
    names = ("buffer_size", "learning_starts", "batch_size", "tau", "gamma", "train_freq", "gradient_steps")
    values = (config.replay_capacity, 2048, 128, 0.005, 0.1, 1, 16, "auto_0.1", -30.0)
    assert settings == dict(zip((*names, "ent_coef", "target_entropy"), values, strict=True))
    n = config.total_env_steps
    rates = {0: 4e-3, n // 2: 2.04e-3, n - 1: 0.08e-3, n: 4e-3, n + n // 2: 2.04e-3}
    for n_steps[0], expected in rates.items():
        assert rate(1.0) == pytest.approx(expected, rel=1e-3)


POINTS = [  # 10 mm at 17 s, 5 mm at 29.5 s
    {"wall_s": wall_s, "trained_s": wall_s - 2, "env_steps": 100, "updates": 1, "median_mm": error_mm}
    for wall_s, error_mm in ((12.0, 12.0), (22.0, 8.0), (32.0, 4.0))
]


@pytest.fixture
def asked(monkeypatch):
    """Limits that each contestant was given, in place of training it; some of them fail."""
    asked = {}

    def made_up(worker, limits):
        asked[worker.name] = limits
        if worker.name in ("sbx-hindsight, seed 0", "ours-quick, seed 3"):
            raise WorkerError(f"{worker.name}: got status 1")
        return {"start_up_s": 2.0, "limit_s": None, "points": POINTS}

    monkeypatch.setattr(race, "train", made_up)
    monkeypatch.setattr(race, "peer_python", lambda name: PINS[name] and sys.executable)
    return asked


def race_in(folder, seeds=(0,), n_goals=8):
    return run(folder, seeds, CONTESTANTS, n_goals)


def test_peers_get_our_time_to_5_mm_as_often_as_the_target_asks_and_stop_where_ours_did(asked, tmp_path):
    results = race_in(tmp_path, (4,))
    sbx, sb3 = (RaceLimits(n * 29.5, 5, n * 29.5 / 40) for n in (20, 15))  # SBX: 5 times quick, 20 analytic
    assert asked == {
        "ours-quick, seed 4": RaceLimits(),
        "ours-analytic, seed 4": RaceLimits(float("inf"), 1, 5 * 29.5 / 40),
        "sbx-hindsight, seed 4": sbx,
        "sb3-contrib-hindsight, seed 4": sb3,
    }
    assert list(asked) == [f"{name}, seed 4" for name in CONTESTANTS]
    assert all("points" in one for one in results)
    # One that does not reach 5 mm: multiples of all its time.
    quick = {"contestant": "ours-quick", "points": POINTS[:2]}
    assert limits_of("sbx-hindsight", [quick]) == RaceLimits(5 * 22.0, 10, 5 * 22.0 / 40)
    # Each target has the time of its own preset.
    quick, analytic = ({"contestant": f"ours-{name}", "points": POINTS} for name in ("quick", "analytic"))
    analytic["points"] = [POINTS[2] | {"wall_s": 5.0}]
    assert limits_of("sbx-hindsight", [quick, analytic]).wall_s == 5 * 29.5  # 20 times 5 s are less


def test_some_may_race_alone_and_the_others_and_those_that_failed_follow(asked, monkeypatch, tmp_path):
    monkeypatch.setattr(race, "save", lambda *_: tmp_path / "race.json")
    assert main(["race", "--only", "sbx-hindsight", "--out", str(tmp_path)]) == 0  # it fails
    assert list(asked) == ["ours-quick, seed 0", "sbx-hindsight, seed 0"]
    asked.clear()
    assert main(["race", "--out", str(tmp_path)]) == 1  # as fast as ours
    assert list(asked) == [f"{name}, seed 0" for name in CONTESTANTS if name != "ours-quick"]


def test_results_of_another_commit_size_or_machine_are_refused(asked, monkeypatch, tmp_path):
    made = {"commit": "a", "uncommitted_changes": True, "packages": {"jax": "1"}, "command": "this"}
    monkeypatch.setattr(race, "provenance", lambda program: dict(made))
    monkeypatch.setattr(race, "machine_kind", lambda: "Abacus, 2 cores")
    before = race_in(tmp_path)
    assert {(one["commit"], one["uncommitted_changes"]) for one in before} == {("a", True)}
    made |= {"command": "that", "uncommitted_changes": False}
    assert race_in(tmp_path) == [one | {"uncommitted_changes": "failed" not in one} for one in before]
    with pytest.raises(RaceError, match="got n_goals 8, expected n_goals 9"):
        race_in(tmp_path, n_goals=9)
    made["commit"] = "b"
    with pytest.raises(
        RaceError, match=r"ours-quick-seed0.json: got commit a, expected commit b; choose another"
    ):
        race_in(tmp_path)
    made["commit"] = "a"
    monkeypatch.setattr(race, "machine_kind", lambda: "Abacus, 4 cores")
    with pytest.raises(RaceError, match="got machine Abacus, 2 cores, expected machine Abacus, 4 cores"):
        race_in(tmp_path)


def test_without_the_first_there_is_no_race_and_other_seeds_are_told(asked, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(race, "save", lambda *_: pytest.fail("written"))
    assert main(["race", "--seeds", "1,3", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr()
    assert "ours-quick" in said.err
    assert "got status 1" in said.out and "29.5" in said.out
    assert not list(tmp_path.glob("*seed3.json"))
    assert len(list(tmp_path.glob("*seed1.json"))) == len(CONTESTANTS)


@pytest.mark.parametrize(
    "times, chosen",
    [
        ({4: [9.0, 1.0, 1.0, 1.0], 1: [3.0] * 4}, 4),
        ({4: [50.0] * 4, 1: [9.0, 60.0, 3.0, 70.0]}, 1),  # the best of three, after one that does not count
        ({4: [50.0] * 4, 1: [3.0, 60.0, 60.0, 60.0]}, 4),
    ],
)
def test_pytorch_gets_the_threads_it_trains_fastest_with(monkeypatch, times, chosen):
    threads, clock = [4], [0.0]
    torch = SimpleNamespace(
        get_num_threads=lambda: threads[0], set_num_threads=lambda n: threads.__setitem__(0, n)
    )
    monkeypatch.setitem(sys.modules, "torch", torch)
    monkeypatch.setattr("benchmarks.race.threads.time.perf_counter", lambda: clock[0])
    left = {n: iter(own) for n, own in times.items()}
    choose_threads(lambda: clock.__setitem__(0, clock[0] + next(left[threads[0]])))
    assert threads == [chosen]
