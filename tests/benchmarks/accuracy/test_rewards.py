"""Differences between kinds of reward, and the summary of their runs."""

from benchmarks.accuracy.rewards import HAND_MADE, LEARNED, config_of, summary
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
