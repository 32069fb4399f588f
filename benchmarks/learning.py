"""Held-out figures of finished training runs, grouped by their settings, with the spread over seeds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from train.checkpoint import Run, RunError
from train.config import to_dict

FIGURES = (
    "median_mm",
    "p95_mm",
    "reached_share",
    "saturated_share",
    "circle_mean_mm",
    "circle_max_mm",
    "circle_saturated_chambers",
)


def measure(folders: list[str]) -> dict[str, Any]:
    """Figures of each run, and mean, least and greatest over the seeds of the same settings.

    Args:
        folders: of runs trained to their end.

    Raises:
        RunError: a folder holds no finished run.
    """
    groups: dict[str, list[dict[str, Any]]] = {}
    for folder in folders:
        run = Run.open(Path(folder))
        settings = to_dict(run.config)
        settings.pop("seed")
        groups.setdefault(json.dumps(settings, sort_keys=True), []).append(_row(run))
    return {
        "groups": [
            {"settings": json.loads(settings), "runs": rows, "over_seeds": _spread(rows)}
            for settings, rows in groups.items()
        ]
    }


def _row(run: Run) -> dict[str, Any]:
    file = run.path / "evaluation.json"
    if not file.exists():
        raise RunError(f"{run.path}: not finished: no evaluation.json")
    rows = run.metrics()
    return {
        "seed": run.config.seed,
        "env_steps": rows[-1]["env_steps"],
        "updates": rows[-1]["updates"],
        **json.loads(file.read_text("utf-8")),
    }


def _spread(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    values = {name: [row[name] for row in rows] for name in FIGURES}
    return {
        name: {"mean": float(np.mean(x)), "min": float(np.min(x)), "max": float(np.max(x))}
        for name, x in values.items()
    }
