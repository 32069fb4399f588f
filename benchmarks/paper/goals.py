"""Goals of the experiments, set before anything was measured, and whether they are met.

A trial that missed a goal pose meets none, however small its error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.paper.measure import CALM_N
from benchmarks.paper.summary import HEAVY_G, LIGHT_G, SUCCESS, Row, all_done

MOST_MM, CALM_PERCENT = 5.0, 99.0
WIDE_RUNS, NARROW_RUNS, OF_RUNS = 8, 7, 9  # for other numbers of runs, the same share


class Check(NamedTuple):
    """A goal beside what was measured."""

    text: str
    value: str
    met: bool


def check_goals(experiment: str, table: Sequence[Row], trainings: Sequence[Row]) -> list[Check]:
    """Check the goals of an experiment.

    Args:
        experiment: "open" or "confined".
        table: from `trial_rows`.
        trainings: from `training_rows`.
    """
    return _open(table) if experiment == "open" else _confined(table, trainings)


def _open(table: Sequence[Row]) -> list[Check]:
    unloaded, without, gradient = (_select(table, kind, "0 g") for kind in ("with", "without", "gradient"))
    light = [row for row in table if 0 < row["load_g"] <= LIGHT_G]
    heavy = [row for row in table if row["load_g"] == HEAVY_G]
    angles = [
        _at_most(f"with S2R, mean {name}", "deg", 3.0, unloaded, f"{name}_deg")
        for name in ("yaw", "pitch", "roll")
    ]
    silent = sum(row["saturated_points"] > 0 and not row["saturation_events"] for row in heavy)
    reported = sum(row["saturation_events"] > 0 for row in heavy)
    n_points = sum(row["saturated_points"] for row in unloaded)
    n_runs = sum(row["saturated_points"] > 0 for row in gradient)
    n_missed, n_incomplete = _n_missed(table)
    return [
        _at_most("with S2R, mean translation", "mm", 5.0, unloaded, "translation_mm"),
        *angles,
        _ratio(without, unloaded),
        _at_most(f"35 to {LIGHT_G} g, mean translation", "mm", 6.0, light, "translation_mm"),
        _at_most("1 kg, largest translation of all runs", "mm", 20.0, heavy, "max_mm", np.max),
        Check(
            "1 kg, saturation detected and reported by the loop",
            f"reported in {reported} of {len(heavy)} runs; in {silent}, a saturated chamber was not reported",
            reported > 0 == silent,
        ),
        Check(
            "with S2R, unloaded: no saturated chamber at any point",
            f"{n_points} points of {len(unloaded)} runs",
            bool(unloaded) and n_points == 0 and not _missed(unloaded),
        ),
        Check(
            "gradient descent saturates at least one chamber",
            f"{sum(row['saturated_points'] for row in gradient)} points, in {n_runs} of {len(gradient)} runs",
            n_runs > 0,
        ),
        Check(
            "every point of every run is reached",
            f"{n_missed} points missed, in {n_incomplete} of {len(table)} runs",
            bool(table) and not n_missed,
        ),
    ]


def _confined(table: Sequence[Row], trainings: Sequence[Row]) -> list[Check]:
    shown, exchanged = _select(table, "pipe", "as shown"), _select(table, "pipe", "exchanged")
    narrow, circle = _select(table, "narrow", "as shown"), _select(table, "circle", "as shown")
    learned, hand_made, stages = (
        [row for row in trainings if row["kind"] == kind] for kind in ("pipe", "hand-made", "circle")
    )
    errors = [
        _at_most(
            f"300 mm pipe: mean absolute error in {axis} at the goals",
            "mm",
            MOST_MM,
            shown,
            f"{axis.lower()}_mm",
        )
        for axis in "XYZ"
    ]
    done = [{(row["twin"], row["seed"]): all_done(row) for row in rows} for rows in (shown, exchanged)]
    both = [done[0].get(key, False) and done[1].get(key, False) for key in done[0].keys() | done[1].keys()]
    return [
        *errors,
        _share_done(
            "300 mm pipe: all four operations done, as shown and exchanged",
            WIDE_RUNS,
            both if shown and exchanged else [],
        ),
        _share_done("250 mm pipe: both tasks done", NARROW_RUNS, [all_done(row) for row in narrow]),
        _calm("300 mm pipe, as shown and exchanged", [*shown, *exchanged] if shown and exchanged else []),
        _calm("250 mm pipe", narrow),
        _fewer_steps(learned, hand_made),
        _not_above(circle, _select(table, "with", "0 g")),
        _kept([row["stages_first_success"] for row in stages]),
    ]


def _select(table: Sequence[Row], kind: str, variant: str) -> list[Row]:
    return [row for row in table if (row["kind"], row["variant"]) == (kind, variant)]


def _n_missed(rows: Sequence[Row]) -> tuple[int, int]:
    """Return the number of missed goal poses, and of the runs that missed any."""
    missed = [row["points"] - row["reached"] for row in rows]
    return sum(missed), sum(n > 0 for n in missed)


def _missed(rows: Sequence[Row]) -> str:
    """Return what to append to a value where goal poses were missed; "" where none was."""
    n, n_runs = _n_missed(rows)
    return f", {n} points missed in {n_runs} of {len(rows)} runs" if n else ""


def _unmeasured(text: str) -> Check:
    return Check(text, "not measured", False)


def _at_most(
    text: str, unit: str, limit: float, rows: Sequence[Row], name: str, over: Callable[[Any], Any] = np.mean
) -> Check:
    text = f"{text} at most {limit:g} {unit}"
    if not rows:
        return _unmeasured(text)
    value = float(over([row[name] for row in rows]))
    return Check(text, f"{value:.2f} {unit}{_missed(rows)}", value <= limit and not _missed(rows))


def _mean_mm(rows: Sequence[Row]) -> float:
    return float(np.mean([row["translation_mm"] for row in rows]))


def _ratio(without: Sequence[Row], unloaded: Sequence[Row]) -> Check:
    text = "translation without S2R over that with it, at least 2"
    if not (without and unloaded):
        return _unmeasured(text)
    ratio, missed = _mean_mm(without) / _mean_mm(unloaded), _missed([*without, *unloaded])
    return Check(text, f"{ratio:.2f}{missed}", ratio >= 2.0 and not missed)


def _share_done(text: str, least: int, done: Sequence[bool]) -> Check:
    text = f"{text}, in at least {least} of {OF_RUNS} runs"
    if not done:
        return _unmeasured(text)
    return Check(text, f"{sum(done)} of {len(done)}", sum(done) * OF_RUNS >= least * len(done))


def _calm(where: str, rows: Sequence[Row]) -> Check:
    text = f"{where}: wall force below {CALM_N:g} N for {CALM_PERCENT:g} % of the time of every run"
    if not rows:
        return _unmeasured(text)
    shares = [row["calm_percent"] for row in rows]
    value = f"{min(shares):.2f} % in the worst run, {np.mean(shares):.2f} % in the mean{_missed(rows)}"
    return Check(text, value, min(shares) >= CALM_PERCENT and not _missed(rows))


def _fewer_steps(learned: Sequence[Row], hand_made: Sequence[Row]) -> Check:
    """Compare environment steps to success.

    A run without success counts as one step more than it had, the least possible. That favours the hand-made
    reward, so every run with the learned one must succeed.
    """
    text = f"learned reward: {100 * SUCCESS:g} % success in fewer environment steps than the hand-made one"
    if not (learned and hand_made):
        return _unmeasured(text)
    means, parts = [], []
    for name, rows in (("learned", learned), ("hand-made", hand_made)):
        means.append(np.mean([row["steps_to_success"] or row["env_steps"] + 1 for row in rows]))
        n_never = sum(row["steps_to_success"] is None for row in rows)
        never = f" or more: never in {n_never} of {len(rows)} runs" if n_never else ""
        parts.append(f"{name} {means[-1]:,.0f} in the mean{never}")
    always = all(row["steps_to_success"] is not None for row in learned)
    return Check(text, "; ".join(parts), always and bool(means[0] < means[1]))


def _not_above(circle: Sequence[Row], without: Sequence[Row]) -> Check:
    text = "circle: mean translation with demonstrations not above that without"
    if not (circle and without):
        return _unmeasured(text)
    mm, without_mm, missed = _mean_mm(circle), _mean_mm(without), _missed([*circle, *without])
    return Check(
        text, f"{mm:.2f} mm with, {without_mm:.2f} mm without{missed}", mm <= without_mm and not missed
    )


def _kept(success: Sequence[Sequence[float] | None]) -> Check:
    """Compare success at the first stage's points after each stage; without any there is nothing to keep."""
    text = "circle: success at the first stage's points after stage two not lower than before, in every run"
    if not success or None in success:
        return _unmeasured(text)
    after = np.array(success)  # (runs, 2)
    lower = int(np.sum(after[:, 1] < after[:, 0]))
    one, two = 100 * after.mean(axis=0)
    value = f"{one:.1f} % after stage one, {two:.1f} % after stage two; lower in {lower} of {len(after)} runs"
    return Check(text, value, lower == 0 and bool(one > 0))
