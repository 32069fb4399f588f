"""The paper's recipe as printed: circle and pipe, learned and hand-made reward, and one change at a time.

All runs are in the simulation at rest, on the training model. Demonstrations are the scripted expert's
postures in this simulation. A run whose results exist is not repeated: seeds and cases may be added.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from benchmarks.harness.common import names_of
from benchmarks.harness.stages import WorkStage, claim, command, run_stages
from mjx_softarm._support import cli, xla
from mjx_softarm.logs.schema import Log, write_log
from mjx_softarm.mechanics.pipe import PIPES
from mjx_softarm.sensing.pose import quaternion_from_pose
from mjx_softarm.spec import ArmSpec
from train.demos.expert import Expert
from train.demos.waypoints import task as waypoints_of
from train.runs.folder import Run

PRESETS = {"circle16": "paper-circle", "pipe300": "paper-pipe"}
LOSSES = {"tqc/critic_loss": "critics' loss", "tqc/actor_loss": "actor's loss"}
LOSSES |= {"gail/discriminator_loss": "discriminator's loss"}


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


@dataclass(frozen=True)
class PrintedSettings:
    """Further settings of the runs."""

    env_steps: int | None = None  # of each run; None: the preset's


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

    Raises:
        InputError: a training failed, or the folder has other settings.
    """
    # Demonstrate, and train what is not trained yet.
    settings = PrintedSettings(env_steps)
    claim(out, settings)
    runs = {name: seeds[:1] if CASES[name].one_seed else seeds for name in cases}
    tasks = dict.fromkeys(CASES[name].task for name in cases)
    demonstrated = [WorkStage(f"demonstrate {t}", (demos_file(t),), demonstrate, (t,)) for t in tasks]
    trained = [
        WorkStage(f"{name}, seed {seed}", (f"{run_name(name, seed)}/evaluation.json",), train, (name, seed))
        for name, own in runs.items()
        for seed in own
    ]
    run_stages(out, settings, [demonstrated, trained])
    metrics = {name: [Run.open(out / run_name(name, n)).metrics() for n in own] for name, own in runs.items()}
    penalised = [name for name in runs if name.startswith("circle-learned")]
    return {
        "cases": [over_seeds(name, metrics[name]) for name in runs],
        "losses": [row for name in penalised for row in loss_rows(name, metrics[name][0])],
        "curves": curves(metrics),
    }


def demos_file(task: str) -> str:
    """Return the path of a task's demonstrations in the folder."""
    return f"demos/{task}.npz"


def run_name(case: str, seed: int) -> str:
    """Return the name of a run's folder."""
    return f"{case}-seed{seed}"


def demonstrate(folder: Path, settings: PrintedSettings, task: str) -> None:
    """Write the demonstrations of a task, the expert's postures as the training model has them."""
    xla.enable_compilation_cache()
    file, spec = folder / demos_file(task), ArmSpec.default()
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


def train(folder: Path, settings: PrintedSettings, name: str, seed: int) -> None:
    """Train a policy of a case, or resume an interrupted run."""
    run, case = folder / run_name(name, seed), CASES[name]
    log, made = run.with_suffix(".log"), run / "evaluation.json"
    if (run / "config.json").exists():
        command(log, "train", "imitate", "--resume", run, makes=made)
        return
    options = ["--preset", PRESETS[case.task], "--seed", seed, "--out", run]
    if pipe := PIPES.get(case.task):
        options += ["--pipe", f"{1e3 * pipe.diameter_m:g}"]
    if settings.env_steps:
        options += ["--learner.total-env-steps", settings.env_steps]
    changes = [f"--{text.removesuffix('=true')}" for text in case.settings]  # a flag has no value
    command(log, "train", "imitate", folder / demos_file(case.task), *options, *changes, makes=made)


FIGURES = (
    *("success_share", "reached_share", "median_mm", "max_mm", "x_mm", "y_mm", "z_mm"),
    *("saturated_positions", "outside_positions"),
)


def over_seeds(name: str, metrics: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """Return the final figures of a case: mean over its seeds, and least and greatest."""
    last = [{key.removeprefix("evaluation/"): x for key, x in rows[-1].items()} for rows in metrics]
    counts = {key: last[0][key] for key in ("env_steps", "updates")}
    spread = {key: _spread([row[key] for row in last]) for key in FIGURES if key in last[0]}
    return {"case": name, "seeds": len(last), **counts, **spread}


def _spread(values: Sequence[float]) -> str:
    mean, low, high = (f"{x:.4g}" for x in (np.mean(values), min(values), max(values)))
    return mean if low == high else f"{mean} ({low} to {high})"


def curves(metrics: Mapping[str, Sequence[Sequence[Mapping[str, Any]]]]) -> dict[str, dict[str, Any]]:
    """Return the success [%] of each seed at the evaluations of each case."""
    found = {}
    for name, runs in metrics.items():
        rows = [[row for row in run if "evaluation/success_share" in row] for run in runs]
        percent = [[round(100 * row["evaluation/success_share"], 1) for row in run] for run in rows]
        found[name] = {"env_steps": [row["env_steps"] for row in rows[0]], "success_percent": percent}
    return found


def loss_rows(name: str, rows: Sequence[Mapping[str, float]]) -> list[dict[str, Any]]:
    """Return how each loss of a run begins, ends and fluctuates.

    The fluctuation is the median change from epoch to epoch, in the second half of the run.
    """
    found = []
    for key, title in LOSSES.items():
        values = np.array([row[key] for row in rows if row["updates"]])
        tenth, half = max(1, len(values) // 10), len(values) // 2
        found.append(
            {
                "case": name,
                "loss": title,
                "first tenth": float(values[:tenth].mean()),
                "last tenth": float(values[-tenth:].mean()),
                "fluctuation": float(np.median(np.abs(np.diff(values[half:])))),
            }
        )
    return found
