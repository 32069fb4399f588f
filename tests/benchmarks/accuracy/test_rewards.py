"""Differences between kinds of reward, what they learn from and are judged at, the summary of their runs."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.accuracy import rewards
from benchmarks.accuracy.rewards import HAND_MADE, LEARNED, PRINTED, config_of, measure, summary, targets
from train.config import to_dict


def test_kinds_differ_in_their_reward_alone():
    learned, hand_made = (to_dict(config_of(reward, "pipe", 4096, 64)) for reward in (LEARNED, HAND_MADE))
    assert learned["tqc"].pop("reward_scale") != hand_made["tqc"].pop("reward_scale")
    assert (learned.pop("learned_weight"), learned.pop("hand_made_weight")) == (1.0, 0.0)
    assert (hand_made.pop("learned_weight"), hand_made.pop("hand_made_weight")) == (0.0, 1.0)
    assert learned == hand_made and learned["expert_share"] > 0.0
    assert learned["vector_steps_per_epoch"] * 64 == 512 and learned["env"]["pipe_diameter_mm"] == 300


def test_a_run_without_success_counts_as_never():
    rest = {"success": 0.5, "median_mm": 2.0, "held_out_success": 0.25, "held_out_median_mm": 4.0}
    found = summary([{"steps_to_success": n, **rest} for n in (1024, None, 512)])
    assert found.pop("steps to 90 %: least, median, most") == "512, 1,024, never"
    assert found == rest


def test_a_learned_reward_is_to_need_fewer_steps_with_the_same_settings():
    steps = {
        "pipe": {LEARNED: [512, 2048, None], HAND_MADE: [1024, 1024, 4096]},
        "hand-made": {LEARNED: [512, 512], HAND_MADE: [None, None]},
    }
    found = targets(
        [
            {"settings": settings, "reward": reward, "steps_to_success": n}
            for settings, of in steps.items()
            for reward, taken in of.items()
            for n in taken
        ]
    )
    text = "90 % success in fewer env steps with the learned reward"
    assert [(row["target"], row["verdict"]) for row in found] == [
        (f"pipe: {text}", "NOT MET"),
        (f"hand-made: {text}", "met"),
    ]
    assert found[0]["measured"] == "2,048 learned, 1,024 hand-made, medians"
    assert found[1]["measured"] == "512 learned, never hand-made, medians"


@pytest.fixture
def lessons(monkeypatch):
    """Keeps what `learn` is given in the place of learning."""
    given = []
    rest = {"steps_to_success": 512, "success": 1.0, "held_out_success": 1.0, "held_out_median_mm": 1.0}

    def learn(reward, config, spec, shown, judged, seeds):
        given.append((reward, len(shown.positions), [len(positions) for positions in judged], list(seeds)))
        return [{"seed": seed, **rest, "median_mm": len(given)} for seed in seeds]

    shows = {"demonstrated": lambda spec: (showing(4), np.zeros((3, 6), np.float32))}
    at_once = {"in_parallel": lambda jobs: {name: f(*sent(inputs)) for name, f, inputs in jobs}}
    for name, value in (shows | {"learn": learn} | at_once).items():
        monkeypatch.setattr(rewards, name, value)
    return given


def sent(inputs):
    """Return what a process would get."""
    return pickle.loads(pickle.dumps(inputs))


def showing(n):
    return SimpleNamespace(positions=np.zeros((n, 6), np.float32))


def test_every_kind_learns_from_the_same_positions_with_all_seeds(lessons):
    found = measure(seeds=(0, 2))
    rewards_told = [LEARNED, HAND_MADE, LEARNED, HAND_MADE, PRINTED]
    assert lessons == [(reward, 4, [4, 3], [0, 2]) for reward in rewards_told]
    assert found["positions"] == {"shown": 4, "held out": 3}
    assert [row["reward"] for row in found["means"]] == rewards_told
    assert [row["settings"] for row in found["means"]] == 2 * ["pipe"] + 2 * ["hand-made"] + ["pipe"]
    assert [row["seed"] for row in found["runs"]] == 5 * [0, 2]
    assert [row["median_mm"] for row in found["runs"]] == [1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    assert [row["median_mm"] for row in found["means"]] == [1, 2, 3, 4, 5]
