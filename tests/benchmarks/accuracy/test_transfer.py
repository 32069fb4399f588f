"""Policies of one simulation in the others."""

import dataclasses

import pytest

from benchmarks.accuracy import transfer
from mjx_softarm._support.errors import InputError
from mjx_softarm.env import EnvConfig


def test_each_simulation_is_known_by_the_settings_of_its_runs():
    for name, changes in transfer.SIMULATIONS.items():
        assert transfer.taught_in(dataclasses.replace(EnvConfig(), **changes)) == name


def test_the_target_is_the_worst_simulation_over_the_policy_s_own():
    row = {"policy": "quick", "learned in": "chain at rest", "chain at rest": 1.0, "twin": 1.5, "rod": 2.1}
    found = transfer.target_of(row)
    assert (found["measured"], found["verdict"]) == ("2.1 times in rod", "NOT MET")
    assert transfer.target_of(row | {"rod": 2.0})["verdict"] == "met"


def test_no_runs_are_an_error():
    with pytest.raises(InputError, match="--runs: got none"):
        transfer.measure(())
