"""The experiments in confined spaces from end to end: what is done, and what is not done again."""

import dataclasses
import json
import re

import pytest
from matplotlib.figure import Figure

from benchmarks.harness.parallel import JobError
from benchmarks.paper import confined, confined_film, confined_report
from benchmarks.paper import experiments as paper
from benchmarks.paper import stages as paper_stages
from benchmarks.paper.confined_measure import save_operated
from benchmarks.paper.confined_report import JSON_FILE
from benchmarks.paper.confined_stages import (
    KINDS,
    Trial,
    circles,
    learned_folder,
    trainings,
    trial_file,
    trials,
)
from benchmarks.paper.measure import save_followed
from benchmarks.paper.stages import SMOKE, Case, claim, result_file
from tests.benchmarks.paper.confined_runs import TINY, calibrate, good_results
from train.config import IMITATION_PRESETS, to_dict


def no_pictures(_):
    names = ("positions", "errors", "errors-narrow", "force", "success", "losses", "circle")
    return {name: (name, Figure()) for name in names}


def inline(jobs):
    return {name: function(*arguments) for name, function, arguments in jobs}


def test_interrupted_benchmark_does_only_what_is_missing(tmp_path, monkeypatch):
    done = []

    def leave(path, what):
        if not path.exists():
            path.parent.mkdir(exist_ok=True, parents=True)
            done.append(what)
            return True
        return False

    def try_out(folder, settings, trial):
        if leave(trial_file(folder, trial), trial):
            save_operated(trial_file(folder, trial), good_results(TINY).trials[trial])

    def follow(folder, settings, case):
        if leave(result_file(folder, case), case):
            save_followed(result_file(folder, case), good_results(TINY).circles[case])

    def learn(folder, settings, kind, twin, seed):
        run = learned_folder(folder, kind, twin, seed)
        if leave(run / "config.json", (kind, twin, seed)):
            config = dataclasses.replace(
                IMITATION_PRESETS[KINDS[kind].preset], total_env_steps=12 * 2048, vector_steps_per_epoch=16
            )
            (run / "config.json").write_text(json.dumps({"train": to_dict(config)}))
            lines = [json.dumps(row) + "\n" for row in good_results(TINY).learned[kind, twin, seed].rows]
            (run / "metrics.jsonl").write_text("".join(lines))

    calibrate(tmp_path, TINY)
    stubs = {"in_parallel": inline, "try_out": try_out, "follow_circle": follow, "learn": learn}
    stubs["demonstrate"] = lambda folder, twin, task: done.append((task, twin))
    stubs["export"] = lambda folder, settings, twin: done.append(("export", twin))
    for name, stub in stubs.items():
        monkeypatch.setattr(confined, name, stub)
    monkeypatch.setattr(paper_stages, "learn_twin", lambda *_: done.append("twin"))
    monkeypatch.setattr(paper_stages, "train_policy", lambda *_: done.append("policy"))
    monkeypatch.setattr(confined_film, "film_pipe", lambda *_: "not here")
    monkeypatch.setattr(confined_report, "draw", no_pictures)
    data = confined.run(tmp_path, tmp_path / "out", TINY)
    assert [check["text"] for check in data["goals"] if not check["met"]] == []
    assert (done.count("twin"), done.count("policy")) == (2, 2)
    at = {item: k for k, item in enumerate(done)}
    assert set(trials(TINY)) | set(circles(TINY)) | set(trainings(TINY)) <= set(done)
    assert {("pipe300", 0), ("pipe250", 1), ("circle16", 1)} <= set(done)
    assert max(at["pipe", t, 0] for t in (0, 1)) < min(at["narrow", t, 0] for t in (0, 1))
    gone = trials(TINY)[3]
    trial_file(tmp_path, gone).unlink()
    done.clear()
    confined.run(tmp_path, tmp_path / "out", TINY)
    assert [item for item in done if isinstance(item, Trial | Case)] == [gone]


def test_both_parts_or_one(tmp_path, monkeypatch, capsys):
    done = []

    def part(name):
        return lambda *_: done.append(name) or {"goals": [{"text": name, "value": "1", "met": True}]}

    monkeypatch.setattr(paper, "run", part("open"))
    monkeypatch.setattr(confined, "run", part("confined"))
    for arguments, expected in (
        ([], ["open", "confined"]),
        (["--only", "confined"], ["confined"]),
        (["--only", "open"], ["open"]),
    ):
        done.clear()
        assert paper.main([*arguments, "--smoke", "--out", str(tmp_path)]) == 0
        assert done == expected
    assert f"report: {tmp_path / 'confined.html'}" in capsys.readouterr().out


def test_folder_of_the_open_part_is_shared(tmp_path):
    claim(tmp_path, SMOKE)
    with pytest.raises(JobError, match="choose another --out"):
        confined.run(tmp_path, tmp_path, TINY)


@pytest.mark.slow
def test_smoke(tmp_path, capsys):
    assert paper.main(["--smoke", "--only", "confined", "--out", str(tmp_path / "run")]) == 0
    assert "goals" in json.loads((tmp_path / "run" / JSON_FILE).read_text("utf-8"))["figures"]
    assert len(list((tmp_path / "run" / "results").iterdir())) == len(trials(SMOKE)) + len(circles(SMOKE))
    assert len(re.findall("^(met|NOT MET) ", capsys.readouterr().out, re.MULTILINE)) == 10
