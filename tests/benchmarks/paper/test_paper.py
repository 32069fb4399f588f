"""The paper's experiments: order of the stages, options of the commands, targets and report; a tiny run."""

import dataclasses
import json

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.harness.stages import load_arrays, save_arrays
from benchmarks.paper import jobs, pictures, report
from benchmarks.paper.experiments import stages
from benchmarks.paper.trial import WAY, TrialOutcome
from benchmarks.paper.trials import (
    KINDS,
    PIPE_KINDS,
    SMOKE,
    Settings,
    Trial,
    demonstrations_path,
    run_path,
    trials,
)
from mjx_softarm import ArmSpec
from mjx_softarm._support import cli
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.policy.file import save_policy
from mjx_softarm.spec import ARM_FILE
from tests.benchmarks.paper.made_up import make_policy
from train.__main__ import COMMANDS

SPEC = ArmSpec.default()
N = SPEC.n_chambers
TINY = Settings(twins=(0, 1), seeds=(0,), n_points=3, loads_g=(500, 1000), beside=("payload", "motion"))


def test_every_trial_has_a_result_of_its_own_after_the_files_that_it_needs():
    for experiment in ("open", "confined"):
        groups = stages(experiment, TINY)
        group_of = {path: k for k, group in enumerate(groups) for stage in group for path in stage.results}
        assert len(group_of) == sum(len(stage.results) for group in groups for stage in group)
        listed = trials(experiment, TINY)
        assert len(set(listed)) == len(listed) == len({trial.result for trial in listed})
        for trial in listed:
            run = run_path(trial.kind, trial.twin, trial.seed)
            needed = [f"{run}/policy.npz"] + ["nominal-seed0/policy.npz"] * (trial.kind == "without")
            assert all(group_of[path] < group_of[trial.result] for path in needed)
            if trial.kind != "specified":
                assert group_of[f"twin{trial.twin}/calibration"] < group_of[f"{run}/evaluation.json"]
            kind = KINDS[trial.kind]
            if kind.task:
                demonstrated = group_of[demonstrations_path(trial.twin, kind.task)]
                assert demonstrated < group_of[f"{run}/evaluation.json"]
            if kind.reward_of:
                source = f"{run_path(kind.reward_of, trial.twin, trial.seed)}/evaluation.json"
                assert group_of[source] < group_of[f"{run}/evaluation.json"]


@pytest.fixture
def ask(monkeypatch):
    """A function: a stage's job and its arguments -> the options of the `train` command that it ran."""
    calls = []
    monkeypatch.setattr(jobs, "command", lambda log, *words, makes: calls.append([*map(str, words)]))

    def run(job, *arguments):
        calls.clear()
        job(*arguments)
        ((program, *words),) = calls
        assert program == "train"
        return cli.read("train", COMMANDS, words)[1]  # an unknown option ends the test

    return run


def test_trainings_have_the_arm_and_the_preset_of_their_kind_and_resume(tmp_path, ask):
    calibration = tmp_path / "twin1/calibration"
    for kind, preset in (("with", "analytic"), ("payload", "payload"), ("motion", "motion")):
        options = ask(jobs.train, tmp_path, Settings(), kind, 1, 2)
        assert (options.preset, options.config.seed, options.calibration) == (preset, 2, calibration)
    options = ask(jobs.train, tmp_path, Settings(), "chambers", 1, 2)
    assert (options.spec, options.calibration) == (calibration / ARM_FILE, None)
    assert options.config.learner.total_env_steps == 524_288
    assert ask(jobs.train, tmp_path, SMOKE, "chambers", 1, 2).config.learner.total_env_steps == 512
    run = tmp_path / run_path("specified", None, 2)
    assert ask(jobs.train, tmp_path, Settings(), "specified", None, 2).out == run
    run.mkdir()
    (run / "config.json").touch()
    assert ask(jobs.train, tmp_path, Settings(), "specified", None, 2).resume == run
    runs = (run.name, run_path("specified", None, 3))
    (run / "policy.npz").touch()
    exported = ask(jobs.export, tmp_path, Settings(), None, runs).keywords["folders"]
    assert exported == (tmp_path / runs[1],)


@pytest.mark.parametrize("kind", PIPE_KINDS)
def test_imitation_has_the_reward_and_the_pipe_of_its_kind(tmp_path, ask, kind):
    options = ask(jobs.imitate, tmp_path, SMOKE, kind, 0, 0)
    learner, env = options.config.learner, options.config.env
    assert learner.n_epochs == 2
    assert env.pipe_diameter_mm == int(KINDS[kind].task.removeprefix("pipe"))
    assert (options.reward is not None) == (kind in ("narrow", "narrow-learned"))
    assert (learner.hand_made_weight > 0) == (kind == "narrow" or kind.endswith("hand-made"))
    assert (learner.learned_weight > 0) == (not kind.endswith("hand-made"))


def test_a_run_that_lacks_its_checkpoint_or_config_starts_anew(tmp_path, ask):
    run = tmp_path / run_path("pipe", 1, 2)
    for made, resumes in ((("config.json",), False), (("checkpoints/0",), False)):
        for name in made:
            (run / name).mkdir(parents=True)
        assert (ask(jobs.imitate, tmp_path, TINY, "pipe", 1, 2).resume == run) is resumes
        assert not run.exists()
    (run / "checkpoints/0").mkdir(parents=True)
    (run / "config.json").touch()
    assert ask(jobs.imitate, tmp_path, TINY, "pipe", 1, 2).resume == run


def test_without_s2r_the_nominal_policy_plans_and_the_springs_are_calibrated(tmp_path, make_arm_model):
    calibrated = SPEC.replace(sensor={"beta": 0.9, "delta_m": 0.004}, springs={"length_min_m": 0.1})
    for twin, spec in ((None, SPEC), (0, calibrated)):
        run = tmp_path / run_path("with", twin, 0)
        run.mkdir()
        save_policy(run / "policy.npz", make_policy(make_arm_model, spec))
    controllers = {kind: jobs.controller_of(tmp_path, Trial(kind, 0, 0)) for kind in ("without", "specified")}
    beta = {kind: controller.policy.sensor.beta for kind, controller in controllers.items()}
    assert np.array_equal(beta["without"], calibrated.spring_sensor.beta)
    assert np.array_equal(beta["specified"], SPEC.spring_sensor.beta)
    pose, goal = circle_poses(SPEC, 2).astype(float)
    plans = [controller.plan(pose, goal, np.full(N, 0.2), None) for controller in controllers.values()]
    np.testing.assert_allclose(*plans)


def test_a_policy_goes_to_a_point_on_a_rod(tmp_path, make_arm_model, monkeypatch):
    # The made-up networks' arm reaches no point of the circle.
    monkeypatch.setattr("mjx_softarm.deploy.session.refusals", lambda policy, goals: {})
    settings, trial = dataclasses.replace(TINY, n_points=1, arm="rod"), Trial("with", 0, 0, load_g=500)
    (tmp_path / run_path("with", 0, 0)).mkdir()
    spec = SPEC.replace(control={"ki_kpa_per_ms": 1000.0})  # slow enough for the rod's regulators
    save_policy(tmp_path / run_path("with", 0, 0) / "policy.npz", make_policy(make_arm_model, spec))
    jobs.try_out(tmp_path, settings, trial)
    outcome = load_arrays(TrialOutcome, tmp_path / trial.result)
    assert np.isfinite(outcome.error).all() and not outcome.operation.any()
    assert np.linalg.norm(outcome.error[0, :3]) > 10.0 and not outcome.wall_n.any()
    assert (tmp_path / trial.log).exists()  # it is drawn over time


def made_up(trial, mm=1.0, saturated=0, reported=0, fails=0, pressed=0.0, missed=0, off_g=0.0, tick_s=0.1):
    """An outcome with one error at every goal of four, all operations done but for some."""
    names = ["pick a", "place b", "pick c", "place d"] if trial.objects else [""] * 4
    error = np.zeros((4, 6))
    error[:, 0], error[:missed] = mm, np.nan
    mask = np.zeros((4, N), bool)
    mask[:saturated, 2] = True
    return TrialOutcome(
        goal=circle_poses(SPEC, 4).astype(float),
        name=np.array(names),
        error=error,
        believed=np.full((4, 6), 0.5),
        saturated=mask,
        success=np.array([bool(trial.objects) and k >= fails for k in range(4)]),
        arrival_s=np.arange(1.0, 5.0),
        load_estimate_g=np.full(4, trial.load_g + off_g),
        events=np.array([reported if fault is Fault.SATURATED else 0 for fault in Fault]),
        time_s=(0.04 if trial.moves else tick_s) * np.arange(101),
        wall_n=np.where(np.arange(101) < 101 * pressed, 2.0, 0.0),
        way=np.full(len(WAY), mm if trial.lap_s else np.nan),
    )


def good(experiment):
    """Outcomes that meet every target."""
    outcomes = {}
    for trial in trials(experiment, TINY):
        hit = trial.kind == "gradient" or trial.load_g == 1000
        mm = {"without": 4.0, "specified": 5.0}.get(trial.kind, 1.0)
        outcomes[trial] = made_up(trial, mm, saturated=int(hit), reported=int(hit))
    return outcomes


def unmet(experiment, changes):
    """Beginnings of the targets that are missed with some changed outcomes."""
    outcomes = good(experiment) | {trial: made_up(trial, **change) for trial, change in changes.items()}
    table = report.trial_rows(outcomes)
    rows = report._open(table, "twin") if experiment == "open" else report._confined(table)
    return [row["target"] for row in rows if row["verdict"] != "met"]


FIRST, PIPE = Trial("with", 0, 0), Trial("pipe", 0, 0, "as shown")
HEAVY, LAP, OBSERVED = FIRST._replace(load_g=1000), FIRST._replace(lap_s=20.0), Trial("payload", 0, 0)
XYZ = ["300 mm pipe: mean absolute error in X"]


@pytest.mark.parametrize(
    ("experiment", "changes", "missed"),
    [
        ("open", {}, []),
        ("open", {FIRST: {"mm": 7.0}}, ["with S2R, mean translation", "translation with calibrated"]),
        ("open", {FIRST: {"saturated": 1}}, ["with S2R, unloaded: no saturated"]),
        ("open", {LAP: {"mm": 4.0}}, ["with S2R, once around in 20 s"]),
        ("open", {FIRST._replace(load_g=500): {"mm": 4.5}}, ["500 g, mean translation"]),
        ("open", {HEAVY: {"mm": 12.1, "saturated": 1, "reported": 1}}, ["1 kg, mean", "1 kg, largest"]),
        ("open", {HEAVY: {"saturated": 1}}, ["1 kg, saturation detected"]),  # and not reported
        ("open", {HEAVY: {"off_g": 800.0, "reported": 1}}, ["payload, estimated"]),
        (
            "open",
            {OBSERVED._replace(load_g=1000): {"mm": 12.1}},
            ["1 kg observed, mean", "1 kg observed, largest"],
        ),
        ("open", {t: {} for t in trials("open", TINY) if t.kind == "gradient"}, ["gradient descent"]),
        ("open", {Trial("motion", 1, 0): {"missed": 1}}, ["every point of every run"]),
        ("confined", {}, []),
        ("confined", {PIPE: {"mm": 10.0}}, XYZ),
        ("confined", {PIPE: {"fails": 1}}, ["300 mm pipe: all four operations"]),
        ("confined", {Trial("narrow", 1, 0, "as shown"): {"fails": 2}}, ["250 mm pipe: both tasks"]),
        ("confined", {PIPE._replace(objects="exchanged"): {"pressed": 0.05}}, ["300 mm pipe, as shown and"]),
        ("confined", {PIPE._replace(moves=True): {"pressed": 0.05}}, ["300 mm pipe, in motion: wall"]),
        ("confined", {PIPE: {"tick_s": 0.02}}, ["300 mm pipe, in motion: time"]),  # with stops
        ("confined", {Trial("narrowest", 0, 0, "as shown"): {"mm": 99.0, "fails": 4}}, []),  # no target
    ],
)
def test_targets_that_are_missed_are_named(experiment, changes, missed):
    texts = unmet(experiment, changes)
    assert len(texts) == len(missed)
    assert all(text.startswith(start) for text, start in zip(texts, missed, strict=True))


def test_a_figure_that_was_not_measured_is_not_met():
    for rows in (report._open([], "twin"), report._confined([])):
        assert {(row["measured"], row["verdict"]) for row in rows} == {("not measured", "NOT MET")}


def test_spreads_are_over_runs_and_a_missed_goal_is_not_hidden():
    outcomes = good("open") | {FIRST: made_up(FIRST, 3.0, missed=1)}
    spreads = {(item["kind"], item["variant"]): item for item in report.spreads(report.trial_rows(outcomes))}
    unloaded = spreads["with", "0 g"]
    assert (unloaded["runs"], unloaded["incomplete_runs"]) == (2, 1)
    assert unloaded["translation_mm"] == pytest.approx({"mean": 2.0, "std": 1.0, "min": 1.0, "max": 3.0})
    assert unloaded["paper"]["translation_mm"] == 11.59
    assert spreads["with", "1000 g"]["paper"] == {"max_mm": 23.76} and not spreads["gradient", "0 g"]["paper"]
    assert "with", "0 g in 20 s" in spreads


@pytest.fixture
def log():
    """Four ticks; chamber 3 is at its lower limit in one of them, and each spring 2 mm off its reference."""
    pressure_kpa = np.zeros((4, N))
    pressure_kpa[2, 3] = SPEC.chambers.pressure_min_kpa
    reference_m = np.full((4, SPEC.n_springs), 0.18)
    lengths = {
        "readings": 3e6 + 1e9 * reference_m,
        "spring_m": reference_m + 2e-3,
        "reference_m": reference_m,
    }
    return Log("made up", np.arange(4), np.arange(4) / 50.0, pressure_kpa=pressure_kpa, **lengths)


def test_traces_have_a_panel_for_each_quantity_and_load(log):
    assert pictures.at_limits(log, SPEC) == {
        "time with a chamber at a limit [%]": 25.0,
        "chambers at a limit": "3",
        "springs off their references, mean [mm]": 2.0,
    }
    figure = pictures.traces_figure({0: log, 500: log}, SPEC)
    assert len(figure.axes) == 6
    assert len(figure.axes[2].lines) == 2 * SPEC.n_springs  # with their references
    assert len(figure.axes[4].lines) == N + 2  # with the limits


def test_results_are_written_whole_without_what_is_no_number(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "_draw", lambda *_: None)
    for twin in TINY.twins:
        home = tmp_path / f"twin{twin}/calibration"
        home.mkdir(parents=True)
        (home / "report.json").write_text('{"parts": {"Springs": {"warnings": ["off by much"]}}}')
    for trial, outcome in (good("confined") | {PIPE: made_up(PIPE, missed=4)}).items():
        save_arrays(tmp_path / trial.result, outcome)
    report.write_report("confined", tmp_path, tmp_path / "made", TINY)
    figures = json.loads((tmp_path / "made/paper-confined.json").read_text("utf-8"))["figures"]
    assert figures["targets"][0]["measured"] == "nan mm, 4 points missed in 1 of 2 runs"
    assert [row["x_mm"] is None for row in figures["runs"]].count(True) == 1
    assert figures["calibrations"]["twin 1"] == {"Springs": ["off by much"]}


@pytest.mark.slow
@pytest.mark.parametrize("experiment", ["open", "confined", "independence"])
def test_smoke(tmp_path, experiment):
    assert main(["paper", "--smoke", "--only", experiment, "--out", str(tmp_path)]) == 0
    made = json.loads((tmp_path / f"paper-{experiment}.json").read_text("utf-8"))
    assert made["figures"]["targets" if experiment != "independence" else "under loads"]
