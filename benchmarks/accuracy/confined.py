"""Pipes that confine: the wall acts on the arm in training, and lips stand in the straight way.

Policies learn from demonstrations of a twin, in a simulation whose wall pushes back. Then they pick and place
on the twin: the objects lie where they were demonstrated, or 30 mm from there. The folder is that of
`benchmarks.paper.trials`; a run whose results exist is not repeated.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness.common import RESULTS, names_of, target
from benchmarks.paper import jobs
from benchmarks.paper.engine import Settings, WorkStage, command, load_arrays, run_stages, save_arrays
from benchmarks.paper.kinds import BOTH, EVALUATION_FILE, HAND_MADE, POLICY_FILE
from benchmarks.paper.measure import TrialOutcome, figures, operate
from benchmarks.paper.scene import CALIBRATION, TRIAL_SESSION, demonstrations_path
from mjx_softarm._support import cli
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.mechanics.pipe import PIPES
from mjx_softarm.policy.file import load_policy
from train.demos.demonstrations import load_demonstrations
from train.demos.waypoints import task as waypoints_of

PICTURE = "confined.png"
OFF_MM = 30.0  # distance of displaced objects from where they were demonstrated
CALM_N, N_OPERATIONS = 5.0, 4
VARIANTS = ("as shown", "30 mm off")


class Case(NamedTuple):
    """A pipe and a reward."""

    task: str  # key of PIPES
    settings: tuple[str, ...] = ()  # NAME=VALUE, beside the preset `pipe`
    reward_of: str = ""  # case whose learned reward it takes, unchanged


CLEARANCE = ("env.clearance_cost_per_mm=1",)
ALONE = (*BOTH, "learner.hand_made_weight=0")
CASES = {
    "lips-learned": Case("lip300"),
    "lips-hand-made": Case("lip300", HAND_MADE),
    "lips-hand-made-clearance": Case("lip300", (*HAND_MADE, *CLEARANCE)),
    "lips-both": Case("lip300", BOTH),
    "narrow-lips-learned-in-wide-ones": Case("lip250", ALONE, reward_of="lips-learned"),
    "200-mm-learned": Case("pipe200"),
    "200-mm-hand-made": Case("pipe200", HAND_MADE),
}


def measure(
    out: Path = Path("runs/confined"),
    twins: cli.Integers = (0, 1, 2),
    seeds: cli.Integers = (0, 1, 2),
    cases: Annotated[tuple[str, ...], names_of(CASES)] = tuple(CASES),
    env_steps: int = 20_480,
) -> dict[str, Any]:
    """Does a pipe that pushes back need demonstrations?

    The picture is `docs/results/confined.png`.

    Args:
        out: working folder: the same command continues, and twins, seeds and cases may be added
        twins: stand-ins for an arm
        seeds: of training
        cases: pipes and rewards
        env_steps: of each training

    Raises:
        JobError: a stage failed.
    """
    # Calibrate and demonstrate, train, export, and try on the twins.
    out.mkdir(parents=True, exist_ok=True)
    runs = [(case, twin, seed) for case in cases for twin in twins for seed in seeds]
    run_stages(out, Settings(), stages(runs, env_steps))
    # Gather the figures, and draw them.
    rows = [
        {"case": case, "twin": twin, "seed": seed, "objects": variant}
        | figures(load_arrays(TrialOutcome, out / trial_file(case, twin, seed, variant)))
        for case, twin, seed in runs
        for variant in VARIANTS
    ]
    force_figure(rows).savefig(RESULTS / PICTURE, dpi=110)
    return {
        "env_steps": env_steps,
        "cases": [summary(case, variant, rows) for case in cases for variant in VARIANTS],
        "targets": targets(rows),
        "runs": rows,
    }


def stages(runs: Sequence[tuple[str, int, int]], env_steps: int) -> list[list[WorkStage]]:
    """Return the stages for runs (case, twin, seed), group by group."""
    # Twins to calibrate, and tasks to demonstrate on them
    twins = sorted({twin for _, twin, _ in runs})
    tasks = dict.fromkeys((twin, CASES[case].task) for case, twin, _ in runs)
    # Trainings, and trials of each policy
    trained = [
        WorkStage(
            f"train {run_name(*run)}", (f"{run_name(*run)}/{EVALUATION_FILE}",), train, (*run, env_steps)
        )
        for run in runs
    ]
    takes_reward = [bool(CASES[case].reward_of) for case, *_ in runs]
    tried = [
        WorkStage(f"try {run_name(*run)}, {variant}", (trial_file(*run, variant),), try_out, (*run, variant))
        for run in runs
        for variant in VARIANTS
    ]
    # Runs that take another run's reward are trained after it
    return [
        [WorkStage(f"twin {t}", (f"twin{t}/{CALIBRATION}",), jobs.calibrate_twin, (t,)) for t in twins],
        [
            WorkStage(f"{task}, twin {t}", (demonstrations_path(t, task),), jobs.demonstrate, (t, task))
            for t, task in tasks
        ],
        [stage for stage, takes in zip(trained, takes_reward, strict=True) if not takes],
        [stage for stage, takes in zip(trained, takes_reward, strict=True) if takes],
        [_export(t, [run_name(*run) for run in runs if run[1] == t]) for t in twins],
        tried,
    ]


def _export(twin: int, names: list[str]) -> WorkStage:
    policies = tuple(f"{name}/{POLICY_FILE}" for name in names)
    return WorkStage(f"export for twin {twin}", policies, jobs.export, (twin, tuple(names)))


def run_name(case: str, twin: int, seed: int) -> str:
    """Return the folder of a run."""
    return f"{case}-twin{twin}-seed{seed}"


def trial_file(case: str, twin: int, seed: int, variant: str) -> str:
    """Return the file of a trial's outcome."""
    return f"trials/{run_name(case, twin, seed)}-{variant.replace(' ', '-')}.npz"


def train(folder: Path, settings: Settings, name: str, twin: int, seed: int, env_steps: int) -> None:
    """Train a policy of a case, or resume an interrupted run."""
    run, case = folder / run_name(name, twin, seed), CASES[name]
    log, pipe = run.with_suffix(".log"), PIPES[case.task]
    if (run / "config.json").exists():
        command(log, "imitate", "--resume", str(run))
        return
    options = ["--preset", "pipe", "--seed", str(seed), "--out", str(run)]
    options += ["--calibration", str(folder / f"twin{twin}" / CALIBRATION)]
    options += ["--pipe", f"{1e3 * pipe.diameter_m:g}", "--env.pipe-lip-mm", f"{1e3 * pipe.lip_m:g}"]
    options += ["--env.pipe-contact", "--learner.total-env-steps", str(env_steps)]
    if case.reward_of:
        options += ["--reward", str(folder / run_name(case.reward_of, twin, seed))]
    options += [f"--{text}" for text in case.settings]
    command(log, "imitate", str(folder / demonstrations_path(twin, case.task)), *options)


def try_out(folder: Path, settings: Settings, case: str, twin: int, seed: int, variant: str) -> None:
    """Let a policy pick and place on its twin, and save the outcome."""
    from mjx_softarm.twin.arm import Twin

    task = CASES[case].task
    policy = load_policy(folder / run_name(case, twin, seed) / POLICY_FILE)
    demonstrations = load_demonstrations(folder / demonstrations_path(twin, task), policy.spec)
    goals = demonstrations.positions.astype(float)
    names = [waypoint.name for waypoint in waypoints_of(task, policy.spec)[0]]
    if variant != VARIANTS[0]:
        goals = displaced(goals, names, seed)
    path = folder / trial_file(case, twin, seed, variant)
    path.parent.mkdir(exist_ok=True)
    arm = Twin(twin, session=TRIAL_SESSION, pipe=PIPES[task])
    save_arrays(path, operate(arm, Controller.of(policy), goals, names, "as shown"))


def displaced(goals: np.ndarray, names: Sequence[str], seed: int) -> np.ndarray:
    """Return goals (p, 6) [mm, deg] whose objects lie `OFF_MM` aside, level with the demonstrated place.

    Objects in a side branch lie aside or nearer to the crossing: the arm reaches little further in.
    """
    moved = goals.copy()
    for k, name in enumerate(names):
        if name.startswith("pick"):
            angle = np.random.default_rng([seed, zlib.crc32(name.encode())]).uniform(0.0, 2 * np.pi)
            x, y = OFF_MM * np.cos(angle), OFF_MM * np.sin(angle)
            inwards = -np.sign(goals[k, 0]) * abs(x)
            moved[k, :2] += x if "bottom" in name else inwards, y
    return moved


def summary(case: str, variant: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the figures of a case over its runs."""
    own = [row for row in rows if row["case"] == case and row["objects"] == variant]
    done = [row["done"] == N_OPERATIONS for row in own]
    errors = {name: float(np.mean([row[name] for row in own])) for name in ("x_mm", "y_mm", "z_mm")}
    return {
        "case": case,
        "objects": variant,
        "runs": len(own),
        "done_runs": sum(done),
        "calm_runs": sum(ok and row["wall_max_n"] <= CALM_N for ok, row in zip(done, own, strict=True)),
        "wall_max_n": max(row["wall_max_n"] for row in own),
        **errors,
        "max_mm": max(row["max_mm"] for row in own),
    }


def targets(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the targets that were set before the measurement, and whether they are met."""
    found = []
    for case, least in (("lips-learned", 9), ("narrow-lips-learned-in-wide-ones", 8)):
        own = [row for row in rows if row["case"] == case and row["objects"] == VARIANTS[0]]
        calm = sum(row["done"] == N_OPERATIONS and row["wall_max_n"] <= CALM_N for row in own)
        text = f"{case}: all operations at no more than {CALM_N:g} N in {least / 9:.0%} of the runs"
        met = 9 * calm >= least * len(own) if own else None
        found.append(target(text, f"{calm} of {len(own)}" if own else "not run", met))
    return found


def force_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the largest force of each run, by case: filled where all operations were done."""
    cases = list(dict.fromkeys(row["case"] for row in rows))
    runs = list(dict.fromkeys((row["twin"], row["seed"]) for row in rows))
    figure = Figure(figsize=(8.0, 0.9 * len(cases) + 1.4), layout="constrained")
    axes = figure.subplots()
    for row in rows:
        shown = row["objects"] == VARIANTS[0]
        done, colour = row["done"] == N_OPERATIONS, "tab:blue" if shown else "tab:orange"
        # Runs stand below each other, so that none hides another
        y = (
            cases.index(row["case"])
            - (0.4 if shown else -0.05)
            + 0.4 * runs.index((row["twin"], row["seed"])) / len(runs)
        )
        face = colour if done else "none"
        axes.scatter(max(row["wall_max_n"], 0.1), y, s=20, edgecolors=colour, facecolors=face, zorder=2)
    axes.axvline(CALM_N, color="0.6", linewidth=1, zorder=1)
    axes.set(xscale="log", xlabel="largest force of the wall [N]; no more than 0.1 N: at the left edge")
    axes.set(yticks=range(len(cases)), yticklabels=cases, ylim=(len(cases) - 0.5, -0.5))
    axes.set_title("blue: objects as shown, orange: 30 mm off; filled: all four operations done", fontsize=10)
    return figure
