"""Held-out figures of finished training runs, grouped by their settings, with the spread over seeds.

Evaluations in a run's folder by `python -m train evaluate`, with a payload or in motion, are included.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.harness.common import target
from mjx_softarm._support.errors import InputError
from train.config import to_dict
from train.presets import PRESETS
from train.runs.folder import Run
from train.sweep.report import by_settings


class FigureTarget(NamedTuple):
    """A bound of a figure's mean over seeds."""

    figure: str
    limit: float
    at_least: bool = False
    spread: str = "over_seeds"


TWELVE = "evaluation-in-motion-12x0.5s_over_seeds"  # twelve actions of half a second
TARGETS = {  # of presets
    "analytic": (
        FigureTarget("median_mm", 0.45),
        FigureTarget("p95_mm", 1.2),
        FigureTarget("reached_share", 0.98, at_least=True),
        FigureTarget("circle_mean_mm", 0.35),
        FigureTarget("even_median_mm", 0.6),
        FigureTarget("even_p95_mm", 3.0),
    ),
    "quick": (FigureTarget("median_mm", 1.5),),
    "motion": (
        FigureTarget("median_mm", 4.0),
        FigureTarget("circle_mean_mm", 0.8),
        FigureTarget("median_mm", 1.0, spread=TWELVE),
        FigureTarget("saturated_share", 0.03, spread=TWELVE),
        FigureTarget("near_median_s", 2.0, spread=TWELVE),
    ),
    "motion-quick": (
        FigureTarget("circle_mean_mm", 1.5),
        FigureTarget("median_mm", 1.5, spread=TWELVE),
    ),
    "motion-analytic": (
        FigureTarget("median_mm", 3.0),
        FigureTarget("near_median_s", 1.2, spread=TWELVE),
    ),
}


def measure(runs: tuple[Path, ...]) -> dict[str, Any]:
    """How exact are finished runs in simulation, over the seeds of the same settings?

    Args:
        runs: folders of finished runs

    Raises:
        InputError: there are no folders.
        RunError: a folder holds no finished run.
    """
    opened = open_runs(runs)
    found = by_settings(opened, lambda run: {k: x for k, x in to_dict(run.config).items() if k != "seed"})
    groups = [{"preset": preset_of(group["settings"]), **group} for group in found]
    return {"targets": targets(groups), "groups": groups}


def open_runs(folders: tuple[Path, ...]) -> list[Run]:
    """Open the folders of runs.

    Raises:
        InputError: there are no folders.
        RunError: a folder holds no run.
    """
    if not folders:
        raise InputError("--runs: got none, expected folders of runs")
    return [Run.open(folder) for folder in folders]


def preset_of(settings: Mapping[str, Any]) -> str | None:
    """Return the preset that has these settings, whatever the seed; None where none has."""
    known = {name: {**to_dict(config), "seed": None} for name, config in PRESETS.items()}
    return next((name for name, own in known.items() if own == {**settings, "seed": None}), None)


def targets(groups: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return the targets of the groups' presets."""
    found = []
    for group in groups:
        for aim in TARGETS.get(group["preset"], ()):
            bound = f"at {'least' if aim.at_least else 'most'} {aim.limit:g}"
            which = f"{aim.spread}, {aim.figure}".replace("_", " ")
            text = f"{group['preset']}, {which}: {bound}"
            if aim.spread not in group:
                found.append(target(text, "not evaluated", None))
            elif aim.figure not in group[aim.spread]:  # a settling time, where most never settle
                found.append(target(text, "none in some run", False))
            else:
                mean = group[aim.spread][aim.figure]["mean"]
                met = mean >= aim.limit if aim.at_least else mean <= aim.limit
                found.append(target(text, f"{mean:.4g}", met))
    return found
