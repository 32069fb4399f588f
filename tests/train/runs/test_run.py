"""Texts that training prints."""

import pytest

from train.runs import run


@pytest.mark.parametrize(
    ("row", "text"),
    [
        ({"env/episodes": 8.0, "env/successes": 6.0}, "exploring: success 75 % of episodes"),
        ({"env/episodes": 0.0, "env/successes": 0.0}, "exploring: success - % of episodes"),
        ({}, "success 50 % of actions"),
    ],
    ids=["episodes", "none has ended", "arms of the learner"],
)
def test_a_learner_s_success_has_one_meaning_in_all_epochs(row, text):
    assert run._success([row | {"env/reached": 0.5}] * 2) == text
