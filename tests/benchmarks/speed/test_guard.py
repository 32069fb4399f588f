"""The regression guard's verdicts, on made-up figures."""

import json

import pytest

from benchmarks.harness.rounds import WorkerError
from benchmarks.speed import guard, guard_work
from benchmarks.speed.guard import BaselineError, baseline_of, compare, costs_of, read_baseline, store
from benchmarks.speed.guard_work import PRODUCT, PRODUCT_ON_GPU, Sizes, reference_of

SIZES = {"n_arms": 4}


def samples(**costs):
    """Made-up processes: all of cost 1, but for those given."""
    given = {name: costs.get(name, (1.0, 1.0, 1.0)) for name in guard.MEASURED}
    return {
        name: [{"cost": value, "seconds": 2.0 * value} for value in values] for name, values in given.items()
    }


STORED = samples(  # medians of three of these lie from 0.92 to 1.02, from 2.0 to 2.2 and from 3.9 to 4.1
    settle=(0.5, 0.92, 1.0, 1.02, 1.4), tick=(2.0, 2.0, 2.0, 2.2, 2.2), updates=(3.9, 3.9, 4.0, 4.1, 4.1)
)


SECONDS = {PRODUCT: 2.0, PRODUCT_ON_GPU: 1.0, **dict.fromkeys(guard.MEASURED, 8.0)}


def test_a_cost_is_the_least_time_over_the_least_of_its_reference():
    rounds = [SECONDS, SECONDS | {"settle": 3.0}, SECONDS | {PRODUCT: 0.5}]
    costs = costs_of(rounds)
    assert costs.pop("settle") == {"cost": 6.0, "seconds": 3.0}
    assert costs.keys() == set(guard.MEASURED) - {"settle"}
    assert all(own == {"cost": 16.0, "seconds": 8.0} for own in costs.values())


def test_on_a_gpu_its_own_product_is_the_reference_of_what_it_does(monkeypatch):
    assert {reference_of(name) for name in guard.MEASURED} == {PRODUCT}
    monkeypatch.setattr(guard_work.jax, "default_backend", lambda: "gpu")
    costs = {name: own["cost"] for name, own in costs_of([SECONDS]).items()}
    assert costs == {"settle": 8.0, "env_steps": 8.0, "updates": 8.0, "tick": 4.0, "compile": 4.0}


class Program:
    """In the place of a worker: each round takes a second less."""

    def __init__(self, name, program, n_cores):
        assert program == ["benchmarks.speed.guard_work"] and n_cores == 1
        self.name, self.facts, self.n = name, {"compile": 30.0}, 0

    def start(self): ...

    def close(self): ...

    def round(self):
        self.n += 1
        return {name: 20.0 - self.n for name in SECONDS if name != "compile"}


def test_each_process_is_kept_to_a_core_and_has_its_costs(monkeypatch):
    monkeypatch.setattr(guard, "Worker", Program)
    samples = guard.measure(3)
    assert samples["compile"] == [{"cost": 30.0 / (20.0 - guard.N_ROUNDS), "seconds": 30.0}] * 3
    assert samples["tick"] == [{"cost": 1.0, "seconds": 20.0 - guard.N_ROUNDS}] * 3


def test_tolerance_is_twice_the_furthest_median_of_as_many_as_are_compared_or_a_tenth():
    baseline = baseline_of(STORED)
    assert baseline["settle"]["cost"] == 1.0 and baseline["settle"]["tolerance"] == pytest.approx(0.16)
    assert baseline["tick"]["cost"] == 2.0 and baseline["tick"]["tolerance"] == pytest.approx(0.2)
    assert baseline["compile"] == {"cost": 1.0, "tolerance": 0.1, "processes": [1.0, 1.0, 1.0]}


@pytest.mark.parametrize(
    "settle, verdict, change",
    [
        ((1.0, 1.15, 1.3), "same", "+15.0 %"),  # the median counts, so one slow process does not
        ((1.0, 1.17, 1.3), "WORSE", "+17.0 %"),
        ((0.95, 0.85, 0.5), "same", "-15.0 %"),
        ((0.8, 0.83, 1.0), "better", "-17.0 %"),
    ],
)
def test_the_verdict_is_of_the_median_beyond_the_tolerance(settle, verdict, change):
    now = samples(settle=settle, tick=(2.0, 2.0, 2.0), updates=(4.0, 4.0, 4.0))
    rows = {row["work"]: row for row in compare(baseline_of(STORED), now)}
    assert rows["settle"]["verdict"] == verdict and rows["settle"]["change"] == change
    assert {row["verdict"] for name, row in rows.items() if name != "settle"} == {"same"}


def test_a_row_tells_baseline_now_spread_and_seconds():
    now = samples(updates=(4.0, 5.0, 6.0))
    row = next(row for row in compare(baseline_of(STORED), now) if row["work"] == "updates")
    assert row == {
        "work": "updates",
        "baseline": 4.0,
        "now": 5.0,
        "change": "+25.0 %",
        "tolerance": "10.0 %",
        "spread": "40.0 %",
        "seconds": 10.0,
        "verdict": "WORSE",
    }


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine of a made-up kind, whose processes give what is put into the list."""
    measured = []
    monkeypatch.setattr(guard, "FILE", tmp_path / "guard.json")
    monkeypatch.setattr(guard, "machine_kind", lambda: "Abacus, 2 cores")
    monkeypatch.setattr(guard, "measure", lambda n_processes: measured.pop())
    return measured


def test_status_tells_stored_same_worse_and_no_baseline(machine, capsys):
    assert guard.main([]) == 2  # before anything is measured
    said = capsys.readouterr().out
    assert "no baseline for Abacus, 2 cores; it has: none" in said and "guard --store" in said
    machine.append(STORED)
    assert guard.main(["--store"]) == 0
    stored = json.loads(guard.FILE.read_text())["kinds"]["Abacus, 2 cores"]
    assert {"commit", "packages", "machine"} <= stored.keys()
    same = samples(tick=(2.0, 2.1, 2.0), updates=(4.0, 4.0, 4.0))
    machine.append(same)
    assert guard.main([]) == 0 and "nothing is worse" in capsys.readouterr().out
    machine.append(same | {"compile": samples(compile=(1.0, 1.3, 1.4))["compile"]})
    assert guard.main([]) == 1 and "worse: compile" in capsys.readouterr().out


def test_a_baseline_beside_another_reference_is_none(machine, monkeypatch, capsys):
    machine.append(STORED)
    assert guard.main(["--store"]) == 0
    monkeypatch.setattr(guard_work, "N_PRODUCTS", 1 + guard_work.N_PRODUCTS)
    assert guard.main([]) == 2 and "of other work" in capsys.readouterr().out


def test_a_baseline_that_would_let_everything_through_is_not_stored(machine, capsys):
    tick, settle = (2.0, 2.0, 2.0, 2.26, 2.26), (1.0, 1.0, 1.0, 1.12, 1.12)  # 26 % and 24 %
    machine.append(samples(tick=tick, settle=settle))
    assert guard.main(["--store"]) == 2
    said = capsys.readouterr().out
    assert "not stored: the tolerance of tick is above 25 %" in said and "nothing else runs" in said
    assert not guard.FILE.exists()


def test_a_program_that_stops_is_told_and_is_nothing_worse(machine, monkeypatch, capsys):
    def stopped(n_processes):
        raise WorkerError("guard: stopped with status 1, expected a result:\nno memory")

    monkeypatch.setattr(guard, "measure", stopped)
    assert guard.main(["--store"]) == 2
    assert "error: guard: stopped with status 1" in capsys.readouterr().out


@pytest.fixture
def tiny(monkeypatch):
    """Next to no work in this process, with the compilation cache as it was."""
    import jax

    sizes = Sizes(8, 1, 2, 8, 32, 2)
    monkeypatch.setattr(guard_work, "SIZES", {"cpu": sizes, "gpu": sizes})
    before = jax.config.jax_enable_compilation_cache
    yield
    jax.config.update("jax_enable_compilation_cache", before)


@pytest.mark.slow
def test_every_cost_is_measured(tiny):
    facts, work = guard_work.prepare()
    told = facts | work()
    assert told.keys() == {*guard.MEASURED, PRODUCT} and min(told.values()) > 0.0
    assert told["compile"] > told["tick"]


def test_baselines_of_other_machines_stay_and_are_not_compared_with(tmp_path):
    file = tmp_path / "guard.json"
    costs = baseline_of(STORED)
    store(file, "Abacus, 2 cores", {"costs": costs, "sizes": SIZES})
    store(file, "Abacus, 4 cores", {"costs": {}, "sizes": SIZES})
    store(file, "Abacus, 4 cores", {"costs": costs, "sizes": {"n_arms": 8}})
    assert read_baseline(file, "Abacus, 2 cores", SIZES)["costs"] == costs
    with pytest.raises(BaselineError, match="no baseline for Slide rule; it has: Abacus, 2 cores, Abacus, 4"):
        read_baseline(file, "Slide rule", SIZES)
    with pytest.raises(BaselineError, match="the baseline for Abacus, 4 cores is of other work"):
        read_baseline(file, "Abacus, 4 cores", SIZES)
