"""Summary, report and pictures: nothing of made-up results is hidden."""

import json

import numpy as np
import pytest

from benchmarks.paper import film, report
from benchmarks.paper.engine import save_arrays
from benchmarks.paper.kinds import KINDS, Trial, learned_run
from benchmarks.paper.summary import (
    first_stage_success,
    load_off_g,
    load_results,
    spreads,
    steps_to_success,
    trial_rows,
)
from benchmarks.paper.trials import FILMS, trainings, trials
from mjx_softarm.mechanics.excitation import circle_poses
from tests.benchmarks.paper.made_up import (
    SPEC,
    TINY,
    fill,
    goals_of,
    good_results,
    made_up,
    pipe_trial,
    trained,
)
from train.config import to_dict
from train.presets import IMITATION_PRESETS


def test_spreads_group_kinds_and_variants():
    changed = {Trial("with", 1, 0): made_up("with", (3.25,), missed=[0])}
    table = trial_rows(good_results("open", TINY, changed))
    found = {(item["kind"], item["variant"]): item for item in spreads(table)}
    loads = [("with", "0 g"), ("with", "500 g"), ("with", "1000 g")]
    loads += [("gradient", variant) for _, variant in loads]
    assert set(found) == {("specified", "0 g"), ("without", "0 g"), ("chambers", "0 g"), *loads}
    unloaded = found["with", "0 g"]
    assert (unloaded["runs"], unloaded["incomplete_runs"]) == (2, 1)
    assert unloaded["translation_mm"] == pytest.approx({"mean": 2.25, "std": 1.0, "min": 1.25, "max": 3.25})
    assert unloaded["paper"]["translation_mm"] == 11.59
    assert found["without", "0 g"]["paper"]["yaw_deg"] == 13.72
    assert found["with", "1000 g"]["paper"] == {"max_mm": 23.76}
    assert found["gradient", "0 g"]["paper"] == found["gradient", "500 g"]["paper"] == {}
    table = trial_rows(good_results("confined", changed={pipe_trial(): made_up("pipe", fails=(0,))}))
    found = {(item["kind"], item["variant"]): item for item in spreads(table)}
    assert set(found) == {
        *(("pipe", "as shown"), ("pipe", "exchanged"), ("hand-made", "as shown"), ("narrow", "as shown")),
        *(("narrow-learned", "as shown"), ("narrow-hand-made", "as shown")),
        *(("circle", "as shown"), ("quick", "0 g")),
        *(("pipe", "as shown in motion"), ("moving", "as shown in motion")),
    }
    shown = found["pipe", "as shown"]
    assert (shown["runs"], shown["all_done_runs"], shown["incomplete_runs"]) == (9, 8, 0)
    assert shown["paper"]["x_mm"] == 8.93
    assert found["circle", "as shown"]["paper"] == {"translation_mm": 11.29}


def test_load_s_error_is_the_mean_over_the_goals_that_were_arrived_at():
    outcome = made_up("with", missed=[0], estimate_g=470)
    outcome.load_estimate_g[1] = 530
    assert load_off_g(Trial("with", 0, 0, load_g=500), outcome) == 30.0
    assert np.isnan(load_off_g(pipe_trial(), outcome))
    assert np.isnan(load_off_g(Trial("with", 0, 0), made_up("with", missed=range(6))))


def test_steps_and_stages_of_a_training_by_hand():
    training = trained("circle", reaches_at=5, after_one=0.5, after_two=0.75)
    assert steps_to_success(training) == 6000  # evaluated after every second epoch
    assert steps_to_success(trained("pipe", reaches_at=99)) is None
    assert first_stage_success(training) == [0.5, 0.75]
    assert first_stage_success(trained("pipe")) is None


def test_stage_ends_come_from_the_runs_config(tmp_path):
    (tmp_path / "trials").mkdir()
    for trial in trials("confined", TINY):
        save_arrays(tmp_path / trial.result, made_up(trial.kind))
    for item in trainings(TINY):
        run = tmp_path / learned_run(*item)
        run.mkdir()
        config = to_dict(IMITATION_PRESETS[KINDS[item[0]].preset])
        (run / "config.json").write_text(json.dumps({"train": config}))
        (run / "metrics.jsonl").write_text('{"epoch": 1}\n{"epoch": 2}\n')
    found = load_results(tmp_path, "confined", TINY)
    assert set(found.outcomes) == set(trials("confined", TINY))
    assert found.trainings["circle", 0, 0].stage_ends == (7,)  # 20 epochs, a third of them first
    assert found.trainings["pipe", 0, 0].stage_ends == ()
    assert [row["epoch"] for row in found.trainings["pipe", 0, 0].rows] == [1, 2]


def write(experiment, folder, results, filmed=False):
    """Write a report; returns its figures by the JSON file, and the names of all its files."""
    fill(folder, TINY)
    if filmed:
        side = film.SideView("", "", [0, 1], circle_poses(SPEC, 3)[:, :3])
        images = film.frames([np.zeros((20, 15, 3), np.uint8)] * 3, np.zeros((3, 3)), side)
        film.write_gif(folder / FILMS[experiment], images)
    report.write_report(experiment, folder, folder / "out", TINY, results)
    written = json.loads((folder / "out" / f"paper-{experiment}.json").read_text("utf-8"))
    assert "commit" in written
    assert all(path.stat().st_size < 150_000 for path in (folder / "out").glob("*.png"))
    return written["figures"], {path.name for path in (folder / "out").iterdir()}


def test_open_results_are_written_and_nothing_is_hidden(tmp_path):
    results = good_results("open", TINY, {Trial("with", 0, 0): made_up("with", missed=range(6))})
    figures, files = write("open", tmp_path, results, filmed=True)
    assert files == {"paper-open.json", "paper-circle.gif", "paper-circle.png"}
    assert (tmp_path / "out" / "paper-circle.gif").read_bytes()[:6] == b"GIF89a"
    assert figures["targets"][0]["measured"] == "nan mm, 6 points missed in 1 of 2 runs"
    assert figures["targets"][0]["verdict"] == "NOT MET"
    assert figures["calibrations"] == {"twin 0": {"Springs": []}, "twin 1": {"Springs": ["off <by> much"]}}
    assert len(figures["runs"]) == len(trials("open", TINY))
    assert [row["translation_mm"] is None for row in figures["runs"]].count(True) == 1


def test_confined_results_are_written_and_nothing_is_hidden(tmp_path):
    lost = [pipe_trial(1), pipe_trial(0, kind="narrow"), pipe_trial(1, kind="narrow")]
    changed = {t: made_up(t.kind, fails=range(4), missed=range(len(goals_of(t.kind)[1]))) for t in lost}
    figures, files = write("confined", tmp_path, good_results("confined", TINY, changed), filmed=True)
    assert files == {"paper-confined.json", "paper-confined-pipe.gif"}
    assert figures["targets"][0]["measured"] == "nan mm, 28 points missed in 1 of 2 runs"
    assert [row["verdict"] for row in figures["targets"]].count("NOT MET") == 7
    assert len(figures["trainings"]) == len(trainings(TINY))
    assert [row["x_mm"] is None for row in figures["runs"]].count(True) == 3
