"""Made-up trials and trainings whose figures are known by hand."""

import json

import numpy as np

from benchmarks.paper.engine import Settings
from benchmarks.paper.kinds import KINDS, Trial
from benchmarks.paper.measure import TrialOutcome
from benchmarks.paper.scene import CALIBRATION
from benchmarks.paper.summary import Results, Training, training_rows, trial_rows
from benchmarks.paper.trials import trainings, trials
from mjx_softarm import ArmSpec
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.policy.file import policy_from_actor
from train.demos.waypoints import task

SPEC = ArmSpec.default()
N, GRIPPER_M = SPEC.n_chambers, SPEC.mass.gripper_length_m
FULL = Settings(n_points=6)
TINY = Settings(twins=(0, 1), seeds=(0,), n_points=3, loads_g=(500, 1000))


def goals_of(kind, n_points=6):
    """Names, and poses whose finger tips are at the waypoints, the gripper straight down."""
    if KINDS[kind].task in ("", "circle16"):
        return [""] * n_points, circle_poses(SPEC, n_points).astype(float)
    waypoints = task(KINDS[kind].task, SPEC)[0]
    goal = np.zeros((len(waypoints), 6))
    goal[:, :3] = 1e3 * (np.array([point.finger_m for point in waypoints]) + [0.0, 0.0, GRIPPER_M])
    return [point.name for point in waypoints], goal


def made_up(
    kind,
    error=(1.0, -2.0, 3.0),
    saturated=(),
    reported=0,
    fails=(),
    pressed=0.0,
    missed=(),
    estimate_g=0,
    tick_s=0.25,
):
    """An outcome with one error (up to 6,) at every goal; `pressed`: share of time with 2 N on the wall."""
    names, goal = goals_of(kind)
    ticks = 100
    outcome = TrialOutcome(
        goal=goal,
        name=np.array(names),
        error=np.tile([*error, *[0.0] * (6 - len(error))], (len(goal), 1)),
        believed=np.full_like(goal, 0.5),
        saturated=np.zeros((len(goal), N), bool),
        success=np.array([name.startswith(("pick", "place")) for name in names]),
        arrival_s=np.linspace(1.0, 0.25 * ticks, len(goal)),
        load_estimate_g=np.full(len(goal), float(estimate_g)),
        events=np.array([reported if fault is Fault.SATURATED else 0 for fault in Fault]),
        time_s=tick_s * np.arange(ticks),
        wall_n=np.where(np.arange(ticks) < pressed * ticks, 2.0, 0.0),
    )
    for point, chamber in saturated:
        outcome.saturated[point, chamber] = True
    outcome.success[np.flatnonzero(outcome.operation)[list(fails)]] = False
    outcome.error[list(missed)], outcome.load_estimate_g[list(missed)] = np.nan, np.nan
    return outcome


def trained(kind, reaches_at=4, n=10, after_one=0.5, after_two=0.75):
    """A training with enough success from an epoch on; of a circle, with two stages."""
    rows = []
    for epoch in range(1, n + 1):
        row = {"epoch": epoch, "env_steps": 1000 * epoch, "updates": 10 * epoch}
        if epoch % 2 == 0:
            row["evaluation/success_share"] = 0.95 if epoch >= reaches_at else 0.2
            row["evaluation/success_first_share"] = after_one if epoch <= 4 else after_two
        rows.append(row)
    return Training(rows, (4,) if kind == "circle" else ())


GOOD_MM = {"specified": 5.0, "without": 4.0, "gradient": 2.0, "with": 1.25, "payload": 1.0}
GOOD_MM |= {"quick": 1.25, "circle": 1.0}


def good_results(experiment, settings=FULL, changed=None):
    """Results that meet every target, but for what is changed: trial or training -> outcome or course."""
    outcomes = {}
    for trial in trials(experiment, settings):
        hit = trial.kind == "gradient" or trial.load_g == 1000
        if trial.kind in GOOD_MM:
            error, saturated = (GOOD_MM[trial.kind], 0, 0, -0.5), [(1, 2)] if hit else []
            outcomes[trial] = made_up(trial.kind, error, saturated, 2 * hit, estimate_g=trial.load_g)
        else:
            outcomes[trial] = made_up(trial.kind, tick_s=0.1 if trial.moves else 0.25)
    items = trainings(settings) if experiment == "confined" else []
    found = {item: trained(item[0], reaches_at=8 if item[0] == "hand-made" else 4) for item in items}
    changed = changed or {}
    return Results(
        {trial: changed.get(trial, outcome) for trial, outcome in outcomes.items()},
        {item: changed.get(item, training) for item, training in found.items()},
    )


def tables(results):
    return trial_rows(results), training_rows(results)


def fill(folder, settings):
    """Leave in a folder what calibration would; the second twin's calibration warns."""
    for twin in settings.twins:
        here = folder / f"twin{twin}" / CALIBRATION
        here.mkdir(parents=True)
        parts = {"Springs": {"warnings": ["off <by> much"] if twin else []}}
        (here / "report.json").write_text(json.dumps({"parts": parts}))


def make_policy(make_arm_model, spec=SPEC, s2r=False):
    """A policy whose actor always asks for the middle of its range, and that accepts every goal."""
    dense = {"head": {"kernel": np.zeros((18, 2 * N)), "bias": np.zeros(2 * N)}}
    everywhere = np.float32(np.random.default_rng(0).uniform(-1e4, 1e4, (50, 6)))
    model = make_arm_model(spec, s2r)._replace(workspace=everywhere)
    return policy_from_actor({"params": dense}, spec, RewardConfig(), model, {})


def pipe_trial(twin=0, seed=0, objects="as shown", kind="pipe", moves=False):
    return Trial(kind, twin, seed, objects, moves=moves)
