"""The regression guard's verdicts, on made-up figures."""

import json
from unittest.mock import Mock

import pytest

from benchmarks.__main__ import main
from benchmarks.speed import guard
from benchmarks.speed.guard import baseline_of, compare
from mjx_softarm._support.errors import InputError

KIND = "Abacus, 2 cores"


def samples(**costs):
    """Return made-up processes: all of cost 1, but for those given."""
    given = {name: costs.get(name, (1.0,) * 5) for name in guard.WORK}
    return [dict(zip(given, values, strict=True)) for values in zip(*given.values(), strict=False)]


STORED = samples(  # medians of three of these lie from 0.92 to 1.02 and from 2.0 to 2.2
    settle=(0.5, 0.92, 1.0, 1.02, 1.4), epoch=(2.0, 2.0, 2.0, 2.2, 2.2)
)


def test_tolerance_is_twice_the_furthest_median_of_as_many_as_are_compared_or_a_tenth():
    baseline = baseline_of(STORED)
    assert baseline["settle"]["cost"] == 1.0 and baseline["settle"]["tolerance"] == pytest.approx(0.16)
    assert baseline["epoch"]["cost"] == 2.0 and baseline["epoch"]["tolerance"] == pytest.approx(0.2)
    assert baseline["compile"] == {"cost": 1.0, "tolerance": 0.1, "processes": [1.0] * 5}


@pytest.mark.parametrize(
    "settle, verdict, change",
    [
        ((1.0, 1.15, 1.3), "same", "+15.0%"),  # the median counts, so one slow process does not
        ((1.0, 1.17, 1.3), "WORSE", "+17.0%"),
        ((0.95, 0.85, 0.5), "same", "-15.0%"),
        ((0.8, 0.83, 1.0), "better", "-17.0%"),
    ],
)
def test_the_verdict_is_on_the_median_beyond_the_tolerance(settle, verdict, change):
    rows = {
        row["work"]: row for row in compare(baseline_of(STORED), samples(settle=settle, epoch=(2.0,) * 3))
    }
    assert rows["settle"]["verdict"] == verdict and rows["settle"]["change"] == change
    assert rows["epoch"]["verdict"] == rows["compile"]["verdict"] == "same"


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine of a made-up kind, whose processes give what is put into the list, the last first."""
    measured = []
    monkeypatch.setattr(guard, "FILE", tmp_path / "guard.json")
    monkeypatch.setattr(guard, "cpu_kind", lambda: KIND)
    monkeypatch.setattr(guard, "process_costs", measured.pop)
    return measured


def test_the_status_of_stored_same_worse_and_no_baseline(machine, monkeypatch, capsys):
    assert main(["guard"]) == 2  # before anything is measured
    assert "guard.json: got no baseline of this work on Abacus, 2 cores, expected" in capsys.readouterr().err
    machine += STORED
    assert guard.main(store=True) == 0
    assert {"commit", "packages", "machine"} <= json.loads(guard.FILE.read_text())["kinds"][KIND].keys()
    machine += samples(epoch=(2.0, 2.1, 2.0))
    assert guard.main() == 0
    machine += samples(epoch=(2.0, 2.1, 2.0), compile=(1.0, 1.3, 1.4))
    assert guard.main() == guard.WORSE
    monkeypatch.setattr(guard, "process_costs", Mock(side_effect=InputError("guard: no memory")))
    assert main(["guard"]) == 2 and capsys.readouterr().err == "error: guard: no memory\n"


def test_an_uncertain_baseline_is_not_stored(machine):
    machine += samples(epoch=(1.0, 1.0, 1.0, 1.1, 1.1), settle=(1.0, 1.0, 0.7, 1.3, 1.3))
    with pytest.raises(InputError, match="tolerance of settle: got more, expected at most 0.25"):
        guard.main(store=True)
    assert not guard.FILE.exists()


def test_a_process_that_fails_is_named(monkeypatch):
    monkeypatch.setattr(guard, "MODULE", "no_such_module")
    with pytest.raises(InputError, match="no_such_module: got status 1, expected costs"):
        guard.process_costs()


@pytest.mark.slow
def test_smoke():
    """A real process at its sizes, a minute."""
    costs = guard.process_costs()
    assert costs.keys() == set(guard.WORK) and min(costs.values()) > 0.0
