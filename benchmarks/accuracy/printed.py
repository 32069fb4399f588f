"""The paper's recipe as printed, in simulation at rest: circle and pipe, two rewards, single changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from benchmarks.harness.common import names_of, over_runs
from benchmarks.harness.stages import EVALUATION_FILE, WorkStage, claim, run_stages, train
from mjx_softarm._support import cli, xla
from mjx_softarm.logs.schema import Log, write_log
from mjx_softarm.mechanics.pipe import PIPES
from mjx_softarm.sensing.pose import quaternion_from_pose
from mjx_softarm.spec import ArmSpec
from train.demos.expert import Expert
from train.demos.waypoints import task as waypoints_of
from train.runs.folder import Run

PRESETS = {"circle16": "paper-circle", "pipe300": "paper-pipe"}
FIGURES = ("success_share", "reached_share", "median_mm", "saturated_positions")  # of the last evaluation


class Case(NamedTuple):
    """A preset of the paper with some settings changed."""

    task: str  # key of PRESETS
    settings: tuple[str, ...] = ()  # NAME=VALUE
    one_seed: bool = False  # the first seed alone


HAND_MADE = ("learner.learned_weight=0", "learner.hand_made_weight=1")
NEAR = ("learner.hindsight.reached_share=0.25", "learner.hindsight.near_share=0.5")
EXCHANGE = ("learner.hindsight.exchange_actions=true",)
DISCOUNT = ("learner.gamma=0.5",)
ON_LOGIT = ("learner.gail.penalty_on=logit",)
AT_AGENT = ("learner.expert_start=agent",)
CASES = {
    "circle-learned": Case("circle16"),
    "circle-hand-made": Case("circle16", HAND_MADE),
    "pipe-learned": Case("pipe300"),
    "pipe-hand-made": Case("pipe300", HAND_MADE),
    # One change each.
    "circle-hand-made-near-goals": Case("circle16", (*HAND_MADE, *NEAR), True),
    "circle-hand-made-exchange": Case("circle16", (*HAND_MADE, *EXCHANGE), True),
    "circle-hand-made-discount": Case("circle16", (*HAND_MADE, *DISCOUNT), True),
    "circle-hand-made-all-three": Case("circle16", (*HAND_MADE, *NEAR, *EXCHANGE, *DISCOUNT), True),
    "circle-learned-discount": Case("circle16", DISCOUNT, True),
    "circle-learned-penalty-on-the-logit": Case("circle16", ON_LOGIT, True),
    "circle-learned-expert-at-the-agents-state": Case("circle16", AT_AGENT, True),
    "circle-learned-all-three": Case("circle16", (*DISCOUNT, *ON_LOGIT, *AT_AGENT), True),
    # The penalty's effect on the losses.
    "circle-learned-no-penalty": Case("circle16", ("learner.gail.gradient_penalty=0",), True),
}


def measure(
    out: Path = Path("runs/printed"),
    seeds: cli.Integers = (0, 1, 2),
    cases: Annotated[tuple[str, ...], names_of(CASES)] = tuple(CASES),
    env_steps: int | None = None,
) -> dict[str, Any]:
    """Does the paper's recipe work as printed, in simulation, and what does each change to it bring?

    Args:
        out: working folder: the same command continues, and seeds and cases may be added
        seeds: of training; changes have the first alone
        cases: which; None: all
        env_steps: of each run, with stages in proportion; None: 300,000 on the circle, a million in the pipe
    """
    claim(out, {"env_steps": env_steps})
    runs = {name: seeds[:1] if CASES[name].one_seed else seeds for name in cases}
    tasks = dict.fromkeys(CASES[name].task for name in cases)
    demonstrated = [WorkStage((_demos_file(t),), demonstrate, (t,)) for t in tasks]
    trained = [
        WorkStage((f"{_run_name(name, n)}/{EVALUATION_FILE}",), imitate, (name, n))
        for name in cases
        for n in runs[name]
    ]
    run_stages(out, env_steps, [demonstrated, trained])
    metrics = {name: [Run.open(out / _run_name(name, n)).metrics() for n in runs[name]] for name in cases}
    return {"cases": final_figures(metrics), "curves": curves(metrics)}


def _demos_file(task: str) -> str:
    return f"demos/{task}.npz"


def _run_name(case: str, seed: int) -> str:
    return f"{case}-seed{seed}"


def demonstrate(folder: Path, _: int | None, task: str) -> None:
    """Write the demonstrations of a task, the expert's postures as the training model has them."""
    xla.enable_compilation_cache()
    file, spec = folder / _demos_file(task), ArmSpec.default()
    file.parent.mkdir(exist_ok=True)
    waypoints, pipe = waypoints_of(task, spec)
    plan = Expert(spec, None, pipe).plan(waypoints)
    pose, n = np.asarray(plan.pose, float), len(waypoints)
    write_log(
        file,
        Log(
            source="demonstrations",
            row=np.arange(2, n + 2),
            time_s=np.arange(n, dtype=float),
            readings=spec.spring_sensor.readings(np.asarray(plan.spring_m, float)),
            tip_m=1e-3 * pose[:, :3],
            tip_quaternion=quaternion_from_pose(pose),
            sequence=np.zeros(n),
            reading_name=spec.sensor.reading_name,
        ),
    )


def imitate(folder: Path, env_steps: int | None, name: str, seed: int) -> None:
    """Train a policy of a case."""
    case = CASES[name]
    options = ["--preset", PRESETS[case.task], "--seed", seed]
    if pipe := PIPES.get(case.task):
        options += ["--pipe", f"{pipe.diameter_mm:g}"]
    if env_steps:
        options += ["--learner.total-env-steps", env_steps]
    options += [f"--{text.removesuffix('=true')}" for text in case.settings]  # a flag has no value
    train(folder / _run_name(name, seed), "imitate", folder / _demos_file(case.task), *options)


Metrics = Mapping[str, Sequence[Sequence[Mapping[str, Any]]]]  # rows of each seed of each case


def final_figures(metrics: Metrics) -> list[dict[str, Any]]:
    """Return the spread of the last figures of each case over its seeds."""
    last = [
        {"case": name, **{key.removeprefix("evaluation/"): x for key, x in rows[-1].items()}}
        for name, runs in metrics.items()
        for rows in runs
    ]
    return over_runs(last, ("case", "env_steps", "updates"), FIGURES)


def curves(metrics: Metrics) -> list[dict[str, Any]]:
    """Return the success [%] of each seed at the evaluations of each case."""
    rows = []
    for name, runs in metrics.items():
        evaluated = [[row for row in run if "evaluation/success_share" in row] for run in runs]
        percent = [[round(100 * row["evaluation/success_share"], 1) for row in run] for run in evaluated]
        env_steps = [row["env_steps"] for row in evaluated[0]]
        rows.append({"case": name, "env_steps": env_steps, "success_percent": percent})
    return rows
