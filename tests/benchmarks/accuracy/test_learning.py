"""Figures of finished runs, as `python -m benchmarks learning` gathers them."""

import pytest

from benchmarks.accuracy.learning import measure, preset_of, targets
from mjx_softarm._support.errors import InputError
from train.config import override, to_dict
from train.presets import PRESETS


def test_no_runs_are_refused_before_results_are_overwritten():
    with pytest.raises(InputError, match="--runs: got none, expected folders of runs"):
        measure(())


def settings(name, *changes):
    found = to_dict(override(PRESETS[name], changes))
    del found["seed"]
    return found


def test_settings_are_those_of_a_preset_whatever_the_seed_or_of_none():
    assert all(preset_of(settings(name, "seed=3")) == name for name in PRESETS)
    assert preset_of(settings("quick", "learner.n_arms=64")) is None


def spread(**means):
    return {name: {"mean": mean} for name, mean in means.items()}


def test_targets_are_those_of_the_groups_presets_for_means_over_seeds():
    quick = {"over_seeds": spread(median_mm=2.01)}
    names = ("median_mm", "p95_mm", "circle_mean_mm", "even_median_mm", "even_p95_mm")
    analytic = spread(**dict.fromkeys(names, 0.6), reached_share=0.97)
    groups = [{"preset": "quick", **quick}, {"preset": None}, {"preset": "payload"}]
    moving = {"preset": "motion-analytic", "over_seeds": spread(median_mm=3.0)}
    found = targets([*groups, {"preset": "analytic", "over_seeds": analytic}, moving])
    *found, met, not_evaluated = found
    assert (met["verdict"], not_evaluated["verdict"]) == ("met", "skipped")
    assert not_evaluated["measured"] == "not evaluated"
    never = moving | {"evaluation-in-motion-12x0.5s_over_seeds": spread(median_mm=1.0)}
    assert targets([never])[1]["verdict"] == "NOT MET"
    assert [row["verdict"] == "met" for row in found] == [False, False, True, False, False, True, True]
    assert found[0]["target"] == "quick, over seeds, median mm: at most 1.5"
    assert found[3] == {
        "target": "analytic, over seeds, reached share: at least 0.98",
        "measured": "0.97",
        "verdict": "NOT MET",
    }
