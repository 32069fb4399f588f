"""Held-out figures of finished training runs, grouped by their settings, with the spread over seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mjx_softarm._support.errors import InputError
from train.config import to_dict
from train.runs.checkpoint import Run
from train.sweep.report import by_settings


def measure(runs: tuple[Path, ...]) -> dict[str, Any]:
    """Report tip errors of finished runs, and their spread over the seeds of the same settings.

    Args:
        runs: folders of finished runs

    Raises:
        InputError: there are no folders.
        RunError: a folder holds no finished run.
    """
    if not runs:
        raise InputError("--runs: got none, expected folders of runs")
    return {"groups": by_settings([Run.open(folder) for folder in runs], _all_but_the_seed)}


def _all_but_the_seed(run: Run) -> dict[str, Any]:
    settings = to_dict(run.config)
    del settings["seed"]
    return settings
