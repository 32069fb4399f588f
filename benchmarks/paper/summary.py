"""Means and spreads over twins and seeds, beside the paper's numbers, and whether the goals are met."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.paper.measure import Followed, figures
from benchmarks.paper.stages import Case

AVERAGED = (
    "translation_mm",
    "rmse_mm",
    "max_mm",
    "yaw_deg",
    "pitch_deg",
    "roll_deg",
    "believed_mm",
    "saturated_points",
    "saturated_chambers_max",
    "saturation_events",
)
ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
LIGHT_G, HEAVY_G = 500, 1000  # the paper's "about 9 mm" is of loads up to LIGHT_G
# The paper's physical arm: translation [mm], yaw, pitch, roll [deg]; its figure of the circle.
PAPER: Mapping[str, Mapping[str, float]] = {
    "without": {"translation_mm": 21.01, "yaw_deg": 13.72, "pitch_deg": 2.82, "roll_deg": 6.98},
    "with": {"translation_mm": 11.59, "yaw_deg": 9.54, "pitch_deg": 2.44, "roll_deg": 2.99},
}
PAPER_LOADS_MM, PAPER_HEAVY_MAX_MM, PAPER_SIMULATED_MM = 9.0, 23.76, 3.89


class Spread(NamedTuple):
    """Of one figure over runs."""

    mean: float
    std: float  # of the runs themselves, not of their mean
    min: float
    max: float


class Check(NamedTuple):
    """One of the goals."""

    text: str
    value: str
    met: bool


def rows(results: Mapping[Case, Followed]) -> list[dict[str, Any]]:
    """The table of all runs."""
    return [{**case._asdict(), **figures(followed)} for case, followed in results.items()]


def spread(values: Sequence[float]) -> Spread:
    """Mean, standard deviation, least and greatest; NaN where any of the values is."""
    x = np.asarray(values, float)
    return Spread(*(float(f(x)) for f in (np.mean, np.std, np.min, np.max)))


def summarise(table: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Every method and load: number of runs, spreads over them, the paper's numbers if it has any."""
    groups: dict[tuple[str, int], list[Mapping[str, Any]]] = {}
    for row in table:
        groups.setdefault((row["method"], row["load_g"]), []).append(row)
    return [
        {
            "method": method,
            "load_g": load_g,
            "runs": len(members),
            "incomplete_runs": sum(row["reached"] < row["points"] for row in members),
            **{name: spread([row[name] for row in members])._asdict() for name in AVERAGED},
            "paper": paper(method, load_g),
        }
        for (method, load_g), members in sorted(groups.items())
    ]


def paper(method: str, load_g: int) -> dict[str, float]:
    """What the paper prints for its physical arm; no number of its own for gradient descent."""
    if load_g == 0:
        return dict(PAPER.get(method, {}))
    return {"translation_mm": PAPER_LOADS_MM} if load_g <= LIGHT_G else {"max_mm": PAPER_HEAVY_MAX_MM}


def check_goals(table: Sequence[Mapping[str, Any]]) -> list[Check]:
    """Each goal, the value measured, and whether it is met; a run that missed a point meets none."""
    some = _selector(table)
    unloaded, without, gradient = some("with"), some("without"), some("gradient")
    light = [row for row in table if 0 < row["load_g"] <= LIGHT_G]
    heavy = [row for row in table if row["load_g"] == HEAVY_G]
    checks = [_at_most("with S2R, mean translation", "mm", 5.0, unloaded, "translation_mm", np.mean)]
    for name in ANGLES:
        angle = name.removesuffix("_deg")
        checks.append(_at_most(f"with S2R, mean {angle}", "deg", 3.0, unloaded, name, np.mean))
    checks.append(_ratio(without, unloaded))
    checks.append(_at_most("35 to 500 g, mean translation", "mm", 6.0, light, "translation_mm", np.mean))
    checks.append(_at_most("1 kg, largest translation of all runs", "mm", 20.0, heavy, "max_mm", np.max))
    silent = sum(row["saturated_points"] > 0 and not row["saturation_events"] for row in heavy)
    told = sum(row["saturation_events"] > 0 for row in heavy)
    value = f"told in {told} of {len(heavy)} runs; in {silent}, a saturated chamber was not told"
    checks.append(Check("1 kg, saturation detected and reported by the loop", value, told > 0 == silent))
    n_points = sum(row["saturated_points"] for row in unloaded)
    value = f"{n_points} points of {len(unloaded)} runs"
    met = bool(unloaded) and n_points == 0 and _complete(unloaded)
    checks.append(Check("with S2R, unloaded: no saturated chamber at any point", value, met))
    n_runs = sum(row["saturated_points"] > 0 for row in gradient)
    value = f"{sum(row['saturated_points'] for row in gradient)} points, in {n_runs} of {len(gradient)} runs"
    checks.append(Check("gradient descent saturates at least one chamber", value, n_runs > 0))
    missed = [row for row in table if row["reached"] < row["points"]]
    n_missed = sum(row["points"] - row["reached"] for row in missed)
    value = f"{n_missed} points missed, in {len(missed)} of {len(table)} runs"
    checks.append(Check("every point of every run is arrived at", value, bool(table) and not missed))
    return checks


def _selector(table: Sequence[Mapping[str, Any]]) -> Callable[[str], list[Mapping[str, Any]]]:
    return lambda method: [row for row in table if row["method"] == method and row["load_g"] == 0]


def _complete(members: Sequence[Mapping[str, Any]]) -> bool:
    return all(row["reached"] == row["points"] for row in members)


def _at_most(text: str, unit: str, limit: float, members, name: str, over: Callable) -> Check:
    if not members:
        return Check(f"{text} at most {limit:g} {unit}", "not measured", False)
    value = float(over([row[name] for row in members]))
    met = value <= limit and _complete(members)
    return Check(f"{text} at most {limit:g} {unit}", f"{value:.2f} {unit}", met)


def _ratio(without, unloaded) -> Check:
    text = "translation without S2R over that with it, at least 2"
    if not (without and unloaded):
        return Check(text, "not measured", False)
    means = [np.mean([row["translation_mm"] for row in members]) for members in (without, unloaded)]
    ratio = float(means[0] / means[1])
    return Check(text, f"{ratio:.2f}", ratio >= 2.0 and _complete(unloaded) and _complete(without))
