"""The paper's experiments: who plans, targets and report; a tiny run."""

import json

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.paper import experiments, pictures, report
from benchmarks.paper.trials import Settings, Trial, run_path, trials
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.policy.file import save_policy
from tests.benchmarks.paper.made_up import SPEC, N, make_policy

TINY = Settings(twins=(0, 1), seeds=(0,), n_points=3, loads_g=(500, 1000), beside=("payload",))


def test_without_s2r_the_nominal_policy_plans_and_the_springs_are_calibrated(tmp_path, make_arm_model):
    calibrated = SPEC.replace(sensor={"beta": 0.9, "delta_m": 0.004}, springs={"length_min_m": 0.1})
    for kind, spec in (("specified", SPEC), ("with", calibrated)):
        run = tmp_path / run_path(kind, 0, 0)
        run.mkdir()
        save_policy(run / "policy.npz", make_policy(make_arm_model, spec))
    kinds = "without", "specified"
    controllers = {kind: experiments.controller_of(tmp_path, Trial(kind, 0, 0)) for kind in kinds}
    beta = {kind: controller.policy.sensor.beta for kind, controller in controllers.items()}
    assert np.array_equal(beta["without"], calibrated.spring_sensor.beta)
    assert np.array_equal(beta["specified"], SPEC.spring_sensor.beta)
    pose, goal = circle_poses(SPEC, 2).astype(float)
    plans = [controller.plan(pose, goal, np.full(N, 0.2), None) for controller in controllers.values()]
    np.testing.assert_allclose(*plans)


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
        ("open", {Trial("specified", 1, 0): {"missed": 1}}, ["all kinds: sum of missed"]),
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


def test_time_at_limits_by_hand():
    """Chamber 3 is at its lower limit in one of four ticks, and each spring 2 mm off its reference."""
    pressure_kpa, reference_m = np.zeros((4, N)), np.full((4, SPEC.n_springs), 0.18)
    pressure_kpa[2, 3] = SPEC.chambers.pressure_min_kpa
    lengths = {"readings": 0 * reference_m, "spring_m": reference_m + 2e-3, "reference_m": reference_m}
    log = Log("made up", np.arange(4), np.arange(4) / 50.0, pressure_kpa=pressure_kpa, **lengths)
    assert pictures.at_limits(log, SPEC) == {
        "time with a chamber at a limit [%]": 25.0,
        "chambers at a limit": "3",
        "springs off their references, mean [mm]": 2.0,
    }


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
