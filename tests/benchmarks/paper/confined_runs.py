"""Made-up runs in confined spaces whose figures are known by hand, and what is asked of them."""

import json

import numpy as np

from benchmarks.paper.confined_measure import Operated, finger_tips
from benchmarks.paper.confined_stages import KINDS, Learned, Results, circles, trainings, trials
from benchmarks.paper.measure import Followed
from benchmarks.paper.stages import Settings
from mjx_softarm import ArmSpec
from mjx_softarm.deploy.faults import Fault
from mjx_softarm.mechanics.workspace import circle_poses
from train.demos.waypoints import task

SPEC = ArmSpec.default()
N, GRIPPER_M = SPEC.n_chambers, SPEC.mass.gripper_length_m
FULL = Settings(n_points=6)
TINY = Settings(twins=(0, 1), seeds=(0,), n_points=6)
DOWN = np.array([1.0, 0.0, 0.0, 0.0])  # quaternion of a gripper that hangs straight
X, Y, Z = (f"300 mm pipe: mean absolute error in {a} at the positions at most 5 mm" for a in "XYZ")
BOTH = "300 mm pipe: all four operations done, as shown and exchanged, in at least 8 of 9 runs"
TASKS = "250 mm pipe: both tasks done, in at least 7 of 9 runs"
CALM = "300 mm pipe, as shown and exchanged: wall force below 1 N for 99 % of the time of every run"
CALM_NARROW = "250 mm pipe: wall force below 1 N for 99 % of the time of every run"
STEPS = "learned reward: 90 % success in fewer environment steps than the hand-made one"
CIRCLE = "circle: mean translation with demonstrations not above that without"
KEPT = "circle: success at the first stage's points after stage two not lower than before, in every run"


def positions(kind):
    """Names, and poses whose finger tips are at the waypoints, the gripper straight down."""
    if kind == "circle":
        return [""] * 6, circle_poses(6).astype(float)
    waypoints = task(KINDS[kind].task, SPEC).waypoints
    goal = np.zeros((len(waypoints), 6))
    goal[:, :3] = 1e3 * (np.array([point.finger_m for point in waypoints]) + [0.0, 0.0, GRIPPER_M])
    return [point.name for point in waypoints], goal


def made_up(kind, error_mm=(1.0, -2.0, 3.0), fails=(), ticks=200):
    """A run that is off by so much everywhere, and fails at some of its operations."""
    names, goal = positions(kind)
    error = np.zeros_like(goal)
    error[:, :3] = error_mm
    operation = np.array([name.startswith(("pick", "place")) for name in names])
    success = operation.copy()
    success[np.flatnonzero(operation)[list(fails)]] = False
    return Operated(
        goal=goal,
        error=error,
        saturated=np.zeros((len(goal), N), bool),
        events=np.array([3 if fault is Fault.NOT_SETTLED else 0 for fault in Fault]),
        operation=operation,
        success=success,
        name=np.array(names),
        arrival_s=np.linspace(1.0, 0.02 * ticks, len(goal)),
        time_s=0.02 * np.arange(ticks),
        finger_m=np.tile(finger_tips(goal[:1], GRIPPER_M), (ticks, 1)),
        wall_n=np.zeros(ticks),
        container_n=np.full(ticks, 5.0),
    )


def pressing(run, share, force_n=2.0):
    """The run with the wall touched for a share of the time."""
    wall_n = np.zeros(len(run.time_s))
    wall_n[: round(share * len(wall_n))] = force_n
    return run._replace(wall_n=wall_n)


def learned(kind, reaches_at=4, n=10, after_one=0.5, after_two=0.75):
    """A training whose success is enough from an epoch on; of a circle, with two stages."""
    found = []
    for epoch in range(1, n + 1):
        share = 0.95 if epoch >= reaches_at else 0.2
        row = {"epoch": epoch, "env_steps": 1000 * epoch, "updates": 10 * epoch}
        row |= {"tqc/critic_loss": 1.0 / epoch, "tqc/actor_loss": -epoch, "gail/discriminator_loss": 0.7}
        if epoch % 2 == 0:
            first = after_one if epoch <= 4 else after_two
            row |= {"evaluation/success_share": share, "evaluation/success_first_share": first}
        found.append(row)
    return Learned(found, (4,) if kind == "circle" else ())


def followed(error_mm, n_points=6):
    error = np.zeros((n_points, 6))
    error[:, 0] = error_mm
    point = np.repeat(np.arange(n_points), 2)
    trace = np.zeros((len(point), N))
    return Followed(
        goal=circle_poses(n_points).astype(float),
        error=error,
        believed=0.5 * error,
        saturated=np.zeros((n_points, N), bool),
        events=np.zeros(len(Fault)),
        latency_s=np.zeros(2),
        time_s=0.5 * np.arange(len(point)),
        point=point,
        reference_m=trace,
        spring_m=trace,
        pressure_kpa=trace,
    )


def good_results(settings=FULL):
    """Results that meet every goal."""
    return Results(
        trials={trial: made_up(trial.kind) for trial in trials(settings)},
        learned={
            item: learned(item[0], reaches_at=8 if item[0] == "hand-made" else 4)
            for item in trainings(settings)
        },
        circles={case: followed(4.0) for case in circles(settings)},
    )


def calibrate(folder, settings):
    for twin in settings.twins:
        here = folder / f"twin{twin}" / "calibration"
        here.mkdir(parents=True)
        parts = {"Springs": {"warnings": ["off <by> much"] if twin else []}}
        (here / "report.json").write_text(json.dumps({"parts": parts}))
