"""Held-out figures of finished training runs, grouped by their settings, with the spread over seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from train.config import to_dict
from train.runs.checkpoint import Run
from train.sweep.report import by_settings


def measure(runs: tuple[Path, ...]) -> dict[str, Any]:
    """Return figures of each run, and mean, minimum and maximum over the seeds of the same settings.

    Args:
        runs: folders of finished runs

    Raises:
        RunError: a folder holds no finished run.
    """
    return {"groups": by_settings([Run.open(folder) for folder in runs], _all_but_the_seed)}


def _all_but_the_seed(run: Run) -> dict[str, Any]:
    settings = to_dict(run.config)
    del settings["seed"]
    return settings
