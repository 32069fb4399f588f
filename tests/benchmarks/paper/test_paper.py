"""The paper's experiments: order of the stages, options of the commands, targets and report; a tiny run."""

import dataclasses
import json

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.harness import stages as harness
from benchmarks.paper import experiments, pictures, report
from benchmarks.paper.experiments import stages
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
            needed = [f"{run}/policy.npz"]
            needed += [f"{run_path('specified', None, 0)}/policy.npz"] * (trial.kind == "without")
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
    for module in (experiments, harness):
        monkeypatch.setattr(module, "command", lambda log, *words, makes: calls.append([*map(str, words)]))

    def run(job, *arguments):
        calls.clear()
        job(*arguments)
        ((program, *words),) = calls
        assert program == "train"
        return cli.read("train", COMMANDS, words)[1]  # an unknown option ends the test

    return run


def test_trainings_have_the_arm_and_the_preset_of_their_kind(tmp_path, ask):
    calibration = tmp_path / "twin1/calibration"
    for kind, preset in (("with", "analytic"), ("payload", "payload"), ("motion", "motion")):
        options = ask(experiments.reach, tmp_path, Settings(), kind, 1, 2)
        assert (options.preset, options.config.seed, options.calibration) == (preset, 2, calibration)
    options = ask(experiments.reach, tmp_path, Settings(), "chambers", 1, 2)
    assert (options.spec, options.calibration) == (calibration / ARM_FILE, None)
    assert options.config.learner.total_env_steps == 524_288
    tiny = ask(experiments.reach, tmp_path, SMOKE, "chambers", 1, 2)
    assert tiny.config.learner.total_env_steps == 512
    nominal = [tmp_path / run_path("specified", None, seed) for seed in (2, 3)]
    assert ask(experiments.reach, tmp_path, Settings(), "specified", None, 2).out == nominal[0]
    nominal[0].mkdir()
    (nominal[0] / "policy.npz").touch()
    policies = tuple(f"{run.name}/policy.npz" for run in nominal)
    exported = ask(experiments.export, tmp_path, Settings(), None, policies).keywords["folders"]
    assert exported == (nominal[1],)  # what is there is not made again


@pytest.mark.parametrize("kind", PIPE_KINDS)
def test_imitation_has_the_reward_and_the_pipe_of_its_kind(tmp_path, ask, kind):
    options = ask(experiments.imitate, tmp_path, SMOKE, kind, 0, 0)
    learner, env = options.config.learner, options.config.env
    assert learner.n_epochs == 2
    assert env.pipe_diameter_mm == int(KINDS[kind].task.removeprefix("pipe"))
    assert (options.reward is not None) == (kind in ("narrow", "narrow-learned"))
    assert (learner.hand_made_weight > 0) == (kind == "narrow" or kind.endswith("hand-made"))
    assert (learner.learned_weight > 0) == (not kind.endswith("hand-made"))


def test_without_s2r_the_nominal_policy_plans_and_the_springs_are_calibrated(tmp_path, make_arm_model):
    calibrated = SPEC.replace(sensor={"beta": 0.9, "delta_m": 0.004}, springs={"length_min_m": 0.1})
    for kind, spec in (("specified", SPEC), ("with", calibrated)):
        run = tmp_path / run_path(kind, 0, 0)
        run.mkdir()
        save_policy(run / "policy.npz", make_policy(make_arm_model, spec))
    controllers = {
        kind: experiments.controller_of(tmp_path, Trial(kind, 0, 0)) for kind in ("without", "specified")
    }
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
    experiments.try_out(tmp_path, settings, trial)
    row = json.loads((tmp_path / trial.result).read_text("utf-8"))
    assert row["measured"] == 1 and row["translation_mm"] > 10.0
    assert row["operations"] == row["wall_max_n"] == 0
    assert (tmp_path / trial.log).exists()  # it is drawn over time


def made_up(trial, mm=1.0, saturated=0, reported=0, fails=0, calm=100.0, missed=0, off_g=0.0, seconds=10.0):
    """Return figures with one error at every goal of four, all operations done but for some."""
    errors = dict.fromkeys(("translation_mm", "max_mm", "x_mm", "way_mm"), mm if not missed else np.nan)
    operations = 4 * bool(trial.objects)
    return {
        **trial._asdict(),
        "variant": trial.variant,
        "points": 4,
        "measured": 4 - missed,
        **dict.fromkeys(("y_mm", "z_mm", "rmse_mm", "yaw_deg", "pitch_deg", "roll_deg"), 0.0),
        **errors,
        "saturated_points": saturated,
        "saturation_events": reported,
        "load_off_g": off_g,
        "operations": operations,
        "done": operations - fails,
        "calm_percent": calm,
        "wall_max_n": 0.0,
        "seconds": 0.4 * seconds if trial.moves else seconds,
        "events": {},
        "believed_mm": 0.5,
    }


def good(experiment):
    """Return figures that meet every target."""
    outcomes = {}
    for trial in trials(experiment, TINY):
        hit = trial.kind == "gradient" or trial.load_g == 1000
        mm = {"without": 4.0, "specified": 5.0}.get(trial.kind, 1.0)
        outcomes[trial] = made_up(trial, mm, saturated=int(hit), reported=int(hit))
    return outcomes


def unmet(experiment, changes):
    """Return the targets that are missed with some changed figures."""
    rows = good(experiment) | {trial: made_up(trial, **change) for trial, change in changes.items()}
    targets = report.figures_of(experiment, TINY, list(rows.values()))["targets"]
    return [row["target"] for row in targets if row["verdict"] != "met"]


FIRST, PIPE = Trial("with", 0, 0), Trial("pipe", 0, 0, "as shown")
HEAVY, LAP = FIRST._replace(load_g=1000), FIRST._replace(lap_s=20.0)
OBSERVED, PAYLOAD = Trial("payload", 0, 0, load_g=1000), "with S2R, payload, 1000 g: "
IN_MOTION = "learned reward, as shown in motion: "
S2R, GRADIENT, PIPE_SHOWN = "with S2R, 0 g: ", "gradient descent, 0 g: ", "learned reward, as shown: "


@pytest.mark.parametrize(
    ("experiment", "changes", "missed"),
    [
        ("open", {}, []),
        ("open", {FIRST: {"mm": 7.0}}, [f"{S2R}mean of translation", "calibrated springs, 0 g: mean of"]),
        ("open", {FIRST: {"saturated": 1}}, [f"{S2R}sum of saturated_points"]),
        ("open", {LAP: {"mm": 4.0}}, ["with S2R, 0 g in 20 s: mean of way_mm"]),
        ("open", {HEAVY: {"saturated": 1}}, ["with S2R, 1000 g: sum of unreported"]),
        ("open", {HEAVY: {"off_g": 800.0, "reported": 1}}, ["with S2R: mean of load_off_g"]),
        ("open", {OBSERVED: {"mm": 12.1}}, [f"{PAYLOAD}mean of trans", f"{PAYLOAD}max of max_mm"]),
        ("open", {t: {} for t in trials("open", TINY) if t.kind == "gradient"}, [f"{GRADIENT}sum of satur"]),
        ("open", {Trial("motion", 1, 0): {"missed": 1}}, ["all kinds: sum of missed"]),
        ("confined", {}, []),
        ("confined", {PIPE: {"mm": 10.0}}, [f"{PIPE_SHOWN}mean of x_mm"]),
        ("confined", {PIPE: {"fails": 1}}, ["learned reward, as shown, exchanged: both_orders of all_done"]),
        ("confined", {PIPE._replace(moves=True): {"calm": 95.0}}, [f"{IN_MOTION}min of calm"]),
        ("confined", {PIPE: {"seconds": 2.0}}, [f"{IN_MOTION}mean of seconds over"]),
        ("confined", {Trial("narrowest", 0, 0, "as shown"): {"mm": 99.0, "fails": 4}}, []),  # no target
    ],
)
def test_targets_that_are_missed_are_named(experiment, changes, missed):
    texts = unmet(experiment, changes)
    assert len(texts) == len(missed), texts
    assert all(text.startswith(start) for text, start in zip(texts, missed, strict=True)), texts


def test_a_figure_that_was_not_measured_is_not_met():
    for experiment in ("open", "confined"):
        rows = report.figures_of(experiment, TINY, [])["targets"]
        assert {(row["measured"], row["verdict"]) for row in rows} == {("not measured", "NOT MET")}


@pytest.fixture
def log():
    """Four ticks; chamber 3 is at its lower limit in one of them, and each spring 2 mm off its reference."""
    pressure_kpa = np.zeros((4, N))
    pressure_kpa[2, 3] = SPEC.chambers.pressure_min_kpa
    reference_m = np.full((4, SPEC.n_springs), 0.18)
    lengths = {"spring_m": reference_m + 2e-3, "reference_m": reference_m}
    lengths["readings"] = 3e6 + 1e9 * reference_m
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


def test_results_are_written_with_spreads_and_without_what_is_no_number(tmp_path):
    (tmp_path / "trials").mkdir()
    for trial, figures in (good("confined") | {PIPE: made_up(PIPE, missed=4)}).items():
        (tmp_path / trial.result).write_text(json.dumps({**figures, "at_stops": {}}))
    report.write_report("confined", tmp_path, tmp_path / "made", TINY)
    figures = json.loads((tmp_path / "made/paper-confined.json").read_text("utf-8"))["figures"]
    assert figures["targets"][0]["measured"] == "nan, 4 points missed"
    assert [row["x_mm"] is None for row in figures["runs"]].count(True) == 1
    spreads = {(row["kind"], row["variant"]): row for row in figures["spreads"]}
    assert spreads["pipe", "exchanged"]["runs"] == 2 and spreads["pipe", "exchanged"]["done"] == "4"


@pytest.mark.slow
@pytest.mark.parametrize("experiment", ["open", "confined", "independence"])
def test_smoke(tmp_path, experiment):
    assert main(["paper", "--smoke", "--only", experiment, "--out", str(tmp_path)]) == 0
    made = json.loads((tmp_path / f"paper-{experiment}.json").read_text("utf-8"))
    assert made["figures"]["spreads"]
