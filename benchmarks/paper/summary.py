"""Results of an experiment: a row for each trial and training, spreads over runs, the paper's numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness.common import grouped
from benchmarks.paper.engine import Settings, load_arrays
from benchmarks.paper.kinds import Trial, learned_run
from benchmarks.paper.measure import TrialOutcome, figures
from benchmarks.paper.trials import trainings, trials

Row = Mapping[str, Any]

FIGURES = (  # with a spread over runs
    *("translation_mm", "rmse_mm", "max_mm", "x_mm", "y_mm", "z_mm", "yaw_deg", "pitch_deg", "roll_deg"),
    *("believed_mm", "saturated_points", "saturated_chambers_max", "saturation_events", "done"),
    *("calm_percent", "wall_max_n", "load_off_g", "seconds"),
)
LIGHT_G, HEAVY_G = 500, 1000
N_OPERATIONS = 4
# Numbers of the paper's physical arm by kind and variant. About the narrow pipe the paper says only that both
# tasks were completed.
PAPER: Mapping[tuple[str, str], Mapping[str, float]] = {
    ("without", "0 g"): {"translation_mm": 21.01, "yaw_deg": 13.72, "pitch_deg": 2.82, "roll_deg": 6.98},
    ("with", "0 g"): {"translation_mm": 11.59, "yaw_deg": 9.54, "pitch_deg": 2.44, "roll_deg": 2.99},
    ("pipe", "as shown"): {"x_mm": 8.93, "y_mm": 5.34, "z_mm": 5.13, "done": N_OPERATIONS},
    ("pipe", "exchanged"): {"done": N_OPERATIONS},
    ("narrow", "as shown"): {"done": N_OPERATIONS},
    ("circle", "as shown"): {"translation_mm": 11.29},
}
PAPER_LOADS_MM, PAPER_HEAVY_MAX_MM = 9.0, 23.76  # mean translation up to LIGHT_G, largest at HEAVY_G
SUCCESS = 0.9  # share of the demonstrated poses that counts as learned


class Training(NamedTuple):
    """Course of a training from demonstrations."""

    rows: list[dict[str, Any]]  # metrics, epoch by epoch
    stage_ends: tuple[int, ...]  # epochs after which each stage but the last was over


class Results(NamedTuple):
    """All that an experiment measured."""

    outcomes: dict[Trial, TrialOutcome]
    trainings: dict[tuple[str, int, int], Training]  # by kind, twin, seed; none in open space


def load_results(folder: Path, experiment: str, settings: Settings) -> Results:
    """Read the results of an experiment's stages from the folder."""
    items = trainings(settings) if experiment == "confined" else []
    return Results(
        outcomes={
            trial: load_arrays(TrialOutcome, folder / trial.result) for trial in trials(experiment, settings)
        },
        trainings={item: _load_training(folder / learned_run(*item)) for item in items},
    )


def _load_training(run: Path) -> Training:
    from train.config import from_dict

    config = from_dict(json.loads((run / "config.json").read_text("utf-8"))["train"])
    lines = (run / "metrics.jsonl").read_text("utf-8").splitlines()
    ends = tuple(end for end in config.learner.milestones if end)
    return Training([json.loads(line) for line in lines], ends)


def trial_rows(results: Results) -> list[dict[str, Any]]:
    """Return a row of figures for each trial."""
    return [
        {
            **trial._asdict(),
            "variant": trial.variant,
            **figures(outcome),
            "load_off_g": load_off_g(trial, outcome),
        }
        for trial, outcome in results.outcomes.items()
    ]


def load_off_g(trial: Trial, outcome: TrialOutcome) -> float:
    """Return the mean error of the loop's payload estimate over the goals; NaN in a pipe."""
    seen_g = outcome.load_estimate_g[np.isfinite(outcome.load_estimate_g)]
    return float(np.abs(seen_g - trial.load_g).mean()) if len(seen_g) and not trial.objects else np.nan


def training_rows(results: Results) -> list[dict[str, Any]]:
    """Return a row of figures for each training, evaluated in its own simulation.

    `steps_to_success` is None if the training never succeeded, `stages_first_success` without a second stage.
    """
    return [
        {
            "kind": kind,
            "twin": twin,
            "seed": seed,
            "env_steps": training.rows[-1]["env_steps"],
            "steps_to_success": steps_to_success(training),
            "final_success": float(training.rows[-1]["evaluation/success_share"]),
            "stages_first_success": first_stage_success(training),
        }
        for (kind, twin, seed), training in results.trainings.items()
    ]


def steps_to_success(training: Training) -> int | None:
    """Return the environment steps to the first evaluation with enough success; None without one."""
    name = "evaluation/success_share"
    return next((row["env_steps"] for row in training.rows if row.get(name, 0.0) >= SUCCESS), None)


def first_stage_success(training: Training) -> list[float] | None:
    """Return success at the first stage's poses, after that stage and at the end; None for one stage."""
    if not training.stage_ends:
        return None
    name = "evaluation/success_first_share"
    as_it_ends = next(row for row in training.rows if row["epoch"] == training.stage_ends[0])
    return [float(as_it_ends[name]), float(training.rows[-1][name])]


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return mean, standard deviation (of the runs), minimum and maximum; NaN where any value is NaN."""
    x = np.asarray(values, float)
    return {"mean": float(x.mean()), "std": float(x.std()), "min": float(x.min()), "max": float(x.max())}


def spreads(table: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the spreads of each kind and variant over its runs, with the paper's numbers if it has any."""
    groups = grouped(table, ("kind", "load_g", "variant"))
    return [
        {
            "kind": kind,
            "variant": variant,
            "load_g": load_g,
            "runs": len(rows),
            "incomplete_runs": sum(row["measured"] < row["points"] for row in rows),
            "all_done_runs": sum(map(all_done, rows)),
            **{name: spread([row[name] for row in rows]) for name in FIGURES},
            "paper": paper_numbers(kind, variant, load_g),
        }
        for (kind, load_g, variant), rows in sorted(groups.items())
    ]


def all_done(row: Row) -> bool:
    """Return whether a trial did all the operations of its task."""
    return row["done"] == row["operations"] == N_OPERATIONS


def paper_numbers(kind: str, variant: str, load_g: int = 0) -> dict[str, float]:
    """Return the paper's numbers for its physical arm; none for gradient descent."""
    if load_g and kind == "with":
        return {"translation_mm": PAPER_LOADS_MM} if load_g <= LIGHT_G else {"max_mm": PAPER_HEAVY_MAX_MM}
    return dict(PAPER.get((kind, variant), {}))
