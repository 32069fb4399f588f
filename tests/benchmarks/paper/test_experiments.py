"""The benchmark from end to end: what it runs, what it does not run again, and its exit status."""

import json

import pytest

from benchmarks.__main__ import main
from benchmarks.harness.common import target
from benchmarks.paper import engine, experiments
from benchmarks.paper.engine import SMOKE
from benchmarks.paper.trials import stages, trials
from tests.benchmarks.paper.made_up import TINY, fill, good_results


@pytest.mark.parametrize("experiment", ["open", "confined"])
def test_interrupted_benchmark_runs_only_what_is_missing(tmp_path, monkeypatch, experiment):
    done, results = [], good_results(experiment, TINY)
    named = {stage.name: stage for group in stages(experiment, TINY) for stage in group}

    def leave_results(jobs):
        for name, _, _ in jobs:
            done.append(name)
            for path in named[name].results:
                (tmp_path / path).parent.mkdir(exist_ok=True, parents=True)
                (tmp_path / path).touch()
            if name.startswith("try "):
                trial = named[name].inputs[0]
                engine.save_arrays(tmp_path / trial.result, results.outcomes[trial])
        return {name: "not here" if name == "film" else None for name, _, _ in jobs}

    fill(tmp_path, TINY)
    monkeypatch.setattr(engine, "in_parallel", leave_results)
    monkeypatch.setattr(experiments, "load_results", lambda *_: results)
    data = experiments.run(experiment, tmp_path, tmp_path / "out", TINY)
    assert {row["verdict"] for row in data["targets"]} == {"met"}
    assert {f"try {trial.name}" for trial in trials(experiment, TINY)} | {"film"} <= set(done)
    assert not any(name.startswith("log and calibrate") for name in done)  # `fill` left them
    gone = trials(experiment, TINY)[3]
    (tmp_path / gone.result).unlink()
    done.clear()
    experiments.run(experiment, tmp_path, tmp_path / "out", TINY)
    assert done == [f"try {gone.name}"]


def test_both_experiments_or_one(tmp_path, monkeypatch, capsys):
    done, chosen, met = [], [], [True]

    def run(experiment, folder, pictures, settings):
        done.append((experiment, settings.twins))
        chosen.append((settings.arm, settings.loads_g, settings.preset, settings.training, settings.beside))
        return {"targets": [target(experiment, "1", met[0])], "spreads": []}

    monkeypatch.setattr(experiments, "run", run)
    smoke = ["--smoke", "--out", str(tmp_path)]
    assert main(["paper", *smoke]) == 0
    assert main(["paper", "--only", "confined", "--twins", "1,2", *smoke]) == 0
    assert done == [("open", (0,)), ("confined", (0,)), ("confined", (1, 2))]
    assert f"written: {tmp_path / 'paper-confined.json'}" in capsys.readouterr().out
    rods = ["--arm", "rod", "--loads", "500", "--preset", "analytic", "--env-steps", "64"]
    assert main(["paper", "--only", "open", *rods, *smoke]) == 0
    assert chosen[-1] == ("rod", (500,), "analytic", ("learner.total_env_steps=64",), ())
    assert f"written: {tmp_path / 'paper-rod.json'}" in capsys.readouterr().out
    beside = ["--beside", "quick,quick", "--out", str(tmp_path)]
    assert main(["paper", "--only", "open", *beside]) == 0
    assert chosen[-1][-1] == ("quick",)
    for option in (["--smoke"], ["--only", "confined"]):
        assert main(["paper", *option, *beside]) == 2
        assert "--beside: got quick, expected none with --smoke or" in capsys.readouterr().err
    met[0] = False
    assert main(["paper", "--only", "open", *beside]) == 1
    assert main(["paper", "--only", "open", *smoke]) == 0
    assert main(["paper", "--arm", "rod", *smoke]) == 2
    assert "--only: got None, expected open with --arm rod" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(("experiment", "n_targets"), [("open", 13), ("confined", 12)])
def test_smoke(tmp_path, experiment, n_targets):
    assert main(["paper", "--smoke", "--only", experiment, "--out", str(tmp_path)]) == 0
    made = json.loads((tmp_path / f"paper-{experiment}.json").read_text("utf-8"))
    assert len(made["figures"]["targets"]) == n_targets
    assert len(list((tmp_path / "trials").iterdir())) == len(trials(experiment, SMOKE))
