"""The goals in confined spaces, met, just met and missed, and what sums up runs, on made-up ones."""

import numpy as np
import pytest

from benchmarks.paper.confined_stages import Trial
from benchmarks.paper.confined_summary import (
    check_goals,
    circle_rows,
    first_success,
    rows,
    steps_to_success,
    summarise,
    training_rows,
)
from benchmarks.paper.stages import Case
from tests.benchmarks.paper.confined_runs import (
    BOTH,
    CALM,
    CALM_NARROW,
    CIRCLE,
    KEPT,
    STEPS,
    TASKS,
    X,
    Y,
    Z,
    followed,
    good_results,
    learned,
    made_up,
    pressing,
)

EXCHANGED = Trial("pipe", 2, 1, "exchanged")


def checks(results):
    return check_goals(rows(results), circle_rows(results), training_rows(results))


def unmet(results):
    return [check.text for check in checks(results) if not check.met]


def with_trials(changed):
    given = good_results()
    return given._replace(trials={**given.trials, **changed})


def with_learned(changed):
    given = good_results()
    return given._replace(learned={**given.learned, **changed})


def test_goals_that_are_met():
    assert unmet(good_results()) == []
    assert len(checks(good_results())) == 10


@pytest.mark.parametrize(
    ("changed", "goal"),
    [
        ({Trial("pipe", 0, 0): made_up("pipe", (38.0, 0, 0))}, X),  # (8 + 38) / 9 = 5.1
        ({Trial("pipe", 0, 0): made_up("pipe", (0, -30.0, 0))}, Y),  # (16 + 30) / 9 = 5.1
        ({Trial("pipe", 0, 0): made_up("pipe", (0, 0, 22.0))}, Z),  # (24 + 22) / 9 = 5.1
        ({Trial("pipe", 0, 0): made_up("pipe", fails=(0,)), EXCHANGED: made_up("pipe", fails=(3,))}, BOTH),
        ({Trial("narrow", t, 0): made_up("narrow", fails=(2,)) for t in range(3)}, TASKS),
        ({EXCHANGED: pressing(made_up("pipe"), 0.015)}, CALM),
        ({Trial("narrow", 1, 1): pressing(made_up("narrow"), 0.015)}, CALM_NARROW),
        ({Trial("circle", 0, 0): made_up("circle", (9.0, 0, 0))}, CIRCLE),  # 8 * 14^0.5 + 9 > 36
    ],
)
def test_goal_that_is_missed_by_trials_is_named(changed, goal):
    assert unmet(with_trials(changed)) == [goal]


@pytest.mark.parametrize(
    ("changed", "goal"),
    [
        ({("pipe", 0, 0): learned("pipe", reaches_at=11)}, STEPS),  # in one run, never
        ({("pipe", t, s): learned("pipe", reaches_at=8) for t in range(3) for s in range(3)}, STEPS),  # equal
        ({("circle", 1, 2): learned("circle", after_one=0.5, after_two=0.375)}, KEPT),
        ({("circle", t, s): learned("circle", 4, 10, 0.0, 0.0) for t in range(3) for s in range(3)}, KEPT),
    ],
)
def test_goal_that_is_missed_by_trainings_is_named(changed, goal):
    assert unmet(with_learned(changed)) == [goal]


@pytest.mark.parametrize(
    "results",
    [
        with_trials({Trial("pipe", 0, 0): made_up("pipe", fails=(0,))}),  # 8 of 9
        with_trials({Trial("narrow", t, 0): made_up("narrow", fails=(0, 1)) for t in (0, 1)}),  # 7 of 9
        with_trials({EXCHANGED: pressing(made_up("pipe"), 0.01)}),
        with_trials({EXCHANGED: pressing(made_up("pipe"), 0.5, 0.9)}),
        with_trials({Trial("hand-made", 0, 0): made_up("pipe", (50.0, 50.0, 50.0), fails=(0, 1, 2, 3))}),
        with_learned({("hand-made", 0, 0): learned("hand-made", reaches_at=11)}),
    ],
)
def test_goal_that_is_just_met(results):
    assert unmet(results) == []


def test_run_that_missed_a_position_meets_no_goal_however_small_its_error():
    broken = made_up("pipe", (0.1, 0.1, 0.1))
    broken.error[2] = np.nan
    assert unmet(with_trials({Trial("pipe", 0, 0): broken})) == [X, Y, Z, CALM]
    broken = made_up("circle", (0.1, 0.1, 0.1))
    broken.error[2] = np.nan
    given = with_trials({Trial("circle", 0, 0): broken})
    assert unmet(given) == [CIRCLE]
    value = {check.text: check.value for check in checks(given)}[CIRCLE]
    assert value.endswith("4.00 mm without, 1 positions missed in 1 of 18 runs")
    broken = followed(8.0)
    broken.error[3] = np.nan
    given = good_results()
    assert unmet(given._replace(circles={**given.circles, Case("with", 1, 1): broken})) == [CIRCLE]


def test_reward_that_never_leads_to_success_is_said():
    never = with_learned({("hand-made", 0, 0): learned("hand-made", reaches_at=11)})
    value = {check.text: check.value for check in checks(never)}[STEPS]
    # Eight runs with 8000 steps, and one that counts as 10 001.
    assert value == "learned 4,000 in the mean; hand-made 8,222 in the mean or more: never in 1 of 9 runs"


def test_what_was_not_measured_is_not_met():
    assert {(check.value, check.met) for check in check_goals([], [], [])} == {("not measured", False)}
    given = good_results()
    no_stages = {item: of._replace(stage_ends=()) for item, of in given.learned.items()}
    assert unmet(given._replace(learned=no_stages)) == [KEPT]
    shown = {trial: run for trial, run in given.trials.items() if trial.objects == "as shown"}
    assert unmet(given._replace(trials=shown)) == [BOTH, CALM]
    assert unmet(given._replace(circles={})) == [CIRCLE]


def test_steps_and_stages_of_a_training_by_hand():
    run = learned("circle", reaches_at=5, after_one=0.5, after_two=0.75)
    assert steps_to_success(run) == 6000  # evaluated after every second epoch
    assert steps_to_success(learned("pipe", reaches_at=99)) is None
    assert first_success(run) == [0.5, 0.75]
    assert first_success(learned("pipe")) is None


def test_summary_groups_kinds_and_objects():
    given = with_trials({Trial("pipe", 0, 0): made_up("pipe", (10.0, 0, 0), fails=(0,))})
    found = {(item["kind"], item["objects"]): item for item in summarise(rows(given))}
    expected = {("pipe", "as shown"), ("pipe", "exchanged"), ("hand-made", "as shown")}
    assert set(found) == expected | {("narrow", "as shown"), ("circle", "as shown")}
    shown = found["pipe", "as shown"]
    assert (shown["runs"], shown["all_done_runs"], shown["incomplete_runs"]) == (9, 8, 0)
    assert shown["x_mm"] == pytest.approx({"mean": 2.0, "std": np.sqrt(8.0), "min": 1.0, "max": 10.0})
    assert shown["paper"]["x_mm"] == 8.93
    assert found["circle", "as shown"]["paper"] == {"translation_mm": 11.29}
    assert found["hand-made", "as shown"]["paper"] == {}
