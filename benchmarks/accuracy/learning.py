"""Held-out figures of finished training runs, grouped by their settings, with the spread over seeds.

Evaluations that `python -m train evaluate` wrote into a run's folder, with a payload or in motion, are among
them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.harness.common import target
from mjx_softarm._support.errors import InputError
from train.config import to_dict
from train.presets import PRESETS
from train.runs.checkpoint import Run
from train.sweep.report import by_settings


class Wanted(NamedTuple):
    """A target: a figure's mean over seeds, and what it may be."""

    figure: str
    limit: float
    at_least: bool = False
    spread: str = "over_seeds"


TARGETS = {  # of presets
    "analytic": (
        Wanted("median_mm", 0.5),
        Wanted("p95_mm", 1.5),
        Wanted("reached_share", 0.98, at_least=True),
        Wanted("circle_mean_mm", 0.4),
        Wanted("even_median_mm", 0.8),
        Wanted("even_p95_mm", 4.0),
    ),
    "quick": (Wanted("median_mm", 2.0, spread="tqc_alone_over_seeds"), Wanted("median_mm", 1.0)),
    "motion-analytic": (
        Wanted("median_mm", 3.0),
        Wanted("near_median_s", 1.2, spread="evaluation-in-motion-12x0.5s_over_seeds"),
    ),
}


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
    groups = [
        {"preset": preset_of(group["settings"]), **group}
        for group in by_settings([Run.open(folder) for folder in runs], _all_but_the_seed)
    ]
    return {"targets": targets(groups), "groups": groups}


def _all_but_the_seed(run: Run) -> dict[str, Any]:
    settings = to_dict(run.config)
    del settings["seed"]
    return settings


def preset_of(settings: Mapping[str, Any]) -> str | None:
    """Return the preset that has exactly these settings, whatever its seed; None where none has."""
    return next(
        (name for name, config in PRESETS.items() if to_dict(config) == {"seed": 0, **settings}), None
    )


def targets(groups: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return the targets of the groups' presets."""
    found = []
    for group in groups:
        for wanted in TARGETS.get(group["preset"], ()):
            bound = f"at {'least' if wanted.at_least else 'most'} {wanted.limit:g}"
            which = f"{wanted.spread}, {wanted.figure}".replace("_", " ")
            text = f"{group['preset']}, {which}: {bound}"
            spread = group.get(wanted.spread, {}).get(wanted.figure)
            if spread is None:
                found.append(target(text, "not evaluated", None))
                continue
            mean = spread["mean"]
            met = mean >= wanted.limit if wanted.at_least else mean <= wanted.limit
            found.append(target(text, f"{mean:.4g}", met))
    return found
