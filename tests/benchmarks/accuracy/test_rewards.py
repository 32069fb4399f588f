"""Differences between kinds of reward, what they learn from and are judged at, the summary of their runs."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.accuracy import rewards
from benchmarks.accuracy.rewards import (
    BY_HAND,
    HAND_MADE,
    LEARNED,
    SCRIPTED,
    config_of,
    measure,
    summary,
    targets,
)
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


def test_a_learned_reward_is_to_need_fewer_steps_with_the_same_settings_and_demonstrations():
    steps = {
        ("pipe", SCRIPTED): {LEARNED: [512, 2048, None], HAND_MADE: [1024, 1024, 4096]},
        ("hand-made", SCRIPTED): {LEARNED: [512, 512], HAND_MADE: [None, None]},
    }
    found = targets(
        [
            {"settings": settings, "shown": shown, "reward": reward, "steps_to_success": n}
            for (settings, shown), of in steps.items()
            for reward, taken in of.items()
            for n in taken
        ]
    )
    text = "90 % success in fewer env steps with the learned reward"
    assert [(row["target"], row["verdict"]) for row in found] == [
        (f"pipe, scripted: {text}", "NOT MET"),
        (f"hand-made, scripted: {text}", "met"),
    ]
    assert found[0]["measured"] == "2,048 learned, 1,024 hand-made, medians"
    assert found[1]["measured"] == "512 learned, never hand-made, medians"


@pytest.fixture
def lessons(monkeypatch):
    """Keeps what `learn` is given in the place of learning; a hand shows 10 positions more than its seed."""
    given = []
    rest = {"steps_to_success": 512, "success": 1.0, "held_out_success": 1.0, "held_out_median_mm": 1.0}

    def learn(reward, config, spec, shown, judged, seeds):
        given.append((reward, len(shown.positions), [len(positions) for positions in judged], list(seeds)))
        return [{"seed": seed, **rest, "median_mm": len(given)} for seed in seeds]

    shows = {"demonstrated": lambda spec: (showing(4), np.zeros((3, 6), np.float32))}
    shows["shown_by_hand"] = lambda spec, seed: showing(10 + seed)
    at_once = {"in_parallel": lambda jobs: {name: f(*sent(inputs)) for name, f, inputs in jobs}}
    for name, value in (shows | {"learn": learn} | at_once).items():
        monkeypatch.setattr(rewards, name, value)
    return given


def sent(inputs):
    """Return what a process would get."""
    return pickle.loads(pickle.dumps(inputs))


def showing(n):
    return SimpleNamespace(positions=np.zeros((n, 6), np.float32))


def test_a_hand_shows_each_seed_other_positions_and_all_are_judged_at_the_scripted_ones(lessons):
    found = measure(seeds=(0, 2))
    scripted, by_hand = lessons[:5], lessons[5:]
    assert {(n, tuple(seeds)) for _, n, _, seeds in scripted} == {(4, (0, 2))}
    one, two = (10, [4, 3], [0]), (12, [4, 3], [2])
    assert by_hand == [(LEARNED, *one), (LEARNED, *two), (HAND_MADE, *one), (HAND_MADE, *two)]
    assert all(judged == [4, 3] for _, _, judged, _ in lessons)
    assert found["positions"] == {"shown": 4, "shown by hand": [10, 12], "held out": 3}
    assert [row["shown"] for row in found["means"]] == 5 * [SCRIPTED] + 2 * [BY_HAND]
    assert [row["seed"] for row in found["runs"]] == 7 * [0, 2]
    whose = [row["median_mm"] for row in found["runs"]]  # the lesson, of which scripted ones have both seeds
    assert whose == [1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 7, 8, 9]
    assert [row["median_mm"] for row in found["means"]] == [1, 2, 3, 4, 5, 6.5, 8.5]
