"""Means and spreads over twins and seeds, beside the paper's numbers, and whether the goals are met."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.paper import measure as paper_measure
from benchmarks.paper.confined_measure import CALM_N, figures
from benchmarks.paper.confined_stages import Learned, Results
from benchmarks.paper.summary import Check, spread

Row = Mapping[str, Any]

AVERAGED = (
    "x_mm",
    "y_mm",
    "z_mm",
    "translation_mm",
    "max_mm",
    "saturated_positions",
    "done",
    "calm_percent",
    "wall_max_n",
    "container_max_n",
)
# The paper's physical arm; of the narrow pipe it says no more than that both tasks were completed.
PAPER: Mapping[tuple[str, str], Mapping[str, float]] = {
    ("pipe", "as shown"): {"x_mm": 8.93, "y_mm": 5.34, "z_mm": 5.13, "done": 4},
    ("pipe", "exchanged"): {"done": 4},
    ("narrow", "as shown"): {"done": 4},
    ("circle", "as shown"): {"translation_mm": 11.29},
}
N_OPERATIONS = 4
SUCCESS = 0.9  # share of the positions that counts as learned
MOST_MM, CALM_PERCENT = 5.0, 99.0
WIDE_RUNS, NARROW_RUNS, OF_RUNS = 8, 7, 9  # as the goals have it; of other numbers of runs, the same share


def rows(results: Results) -> list[dict[str, Any]]:
    """The table of all runs on twins."""
    return [{**trial._asdict(), **figures(operated)} for trial, operated in results.trials.items()]


def circle_rows(results: Results) -> list[dict[str, Any]]:
    """The table of the runs around the circle without demonstrations."""
    return [{**case._asdict(), **paper_measure.figures(run)} for case, run in results.circles.items()]


def training_rows(results: Results) -> list[dict[str, Any]]:
    """The table of all trainings, by their own simulation; None is never, or no second stage."""
    return [
        {
            "kind": kind,
            "twin": twin,
            "seed": seed,
            "env_steps": learned.rows[-1]["env_steps"],
            "steps_to_success": steps_to_success(learned),
            "final_success": float(learned.rows[-1]["evaluation/success_share"]),
            "stages_first_success": first_success(learned),
        }
        for (kind, twin, seed), learned in results.learned.items()
    ]


def steps_to_success(learned: Learned) -> int | None:
    """Environment steps to the first evaluation with enough success; None is never."""
    name = "evaluation/success_share"
    return next((row["env_steps"] for row in learned.rows if row.get(name, 0.0) >= SUCCESS), None)


def first_success(learned: Learned) -> list[float] | None:
    """Success at the positions of the first stage, as it ends and in the end; None without another stage."""
    if not learned.stage_ends:
        return None
    name = "evaluation/success_first_share"
    then = next(row for row in learned.rows if row["epoch"] == learned.stage_ends[0])
    return [float(then[name]), float(learned.rows[-1][name])]


def summarise(table: Sequence[Row]) -> list[dict[str, Any]]:
    """Every kind and its objects: number of runs, spreads over them, the paper's numbers if it has any."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in table:
        groups.setdefault((row["kind"], row["objects"]), []).append(row)
    return [
        {
            "kind": kind,
            "objects": objects,
            "runs": len(members),
            "incomplete_runs": sum(not _complete([row]) for row in members),
            "all_done_runs": sum(map(_all_done, members)),
            **{name: spread([row[name] for row in members])._asdict() for name in AVERAGED},
            "paper": dict(PAPER.get((kind, objects), {})),
        }
        for (kind, objects), members in groups.items()
    ]


def check_goals(table: Sequence[Row], without: Sequence[Row], trainings: Sequence[Row]) -> list[Check]:
    """Each goal, the value measured, and whether it is met; a run that missed a position meets none.

    Args:
        table: from `rows`.
        without: from `circle_rows`.
        trainings: from `training_rows`.
    """
    of = _selector(table)
    shown, exchanged, narrow = of("pipe", "as shown"), of("pipe", "exchanged"), of("narrow", "as shown")
    learned, hand_made = ([row for row in trainings if row["kind"] == kind] for kind in ("pipe", "hand-made"))
    return [
        *(_at_most_mm(f"{axis}_mm", shown) for axis in "xyz"),
        _both(shown, exchanged),
        _done("250 mm pipe: both tasks done", NARROW_RUNS, [_all_done(row) for row in narrow]),
        _calm("300 mm pipe, as shown and exchanged", [*shown, *exchanged] if shown and exchanged else []),
        _calm("250 mm pipe", narrow),
        _fewer_steps(learned, hand_made),
        _circle(of("circle", "as shown"), without),
        _kept([row["stages_first_success"] for row in trainings if row["kind"] == "circle"]),
    ]


def _selector(table: Sequence[Row]) -> Callable[[str, str], list[Row]]:
    return lambda kind, objects: [row for row in table if (row["kind"], row["objects"]) == (kind, objects)]


def _complete(members: Sequence[Row]) -> bool:
    return not _missed(members)


def _missed(members: Sequence[Row]) -> str:
    """What a value has to be read with: positions that were not arrived at."""
    missed = [row["positions"] - row["reached"] for row in members if row["reached"] < row["positions"]]
    return f", {sum(missed)} positions missed in {len(missed)} of {len(members)} runs" if missed else ""


def _all_done(row: Row) -> bool:
    return row["done"] == row["operations"] == N_OPERATIONS


def _at_most_mm(name: str, members: Sequence[Row]) -> Check:
    axis = name.removesuffix("_mm").upper()
    text = f"300 mm pipe: mean absolute error in {axis} at the positions at most {MOST_MM:g} mm"
    if not members:
        return Check(text, "not measured", False)
    value = float(np.mean([row[name] for row in members]))
    return Check(text, f"{value:.2f} mm{_missed(members)}", value <= MOST_MM and _complete(members))


def _both(shown: Sequence[Row], exchanged: Sequence[Row]) -> Check:
    """Of each policy, as shown and exchanged."""
    done = [{(row["twin"], row["seed"]): _all_done(row) for row in of} for of in (shown, exchanged)]
    both = [done[0].get(key, False) and done[1].get(key, False) for key in done[0].keys() | done[1].keys()]
    text = "300 mm pipe: all four operations done, as shown and exchanged"
    return _done(text, WIDE_RUNS, both if shown and exchanged else [])


def _done(text: str, wanted: int, done: Sequence[bool]) -> Check:
    text = f"{text}, in at least {wanted} of {OF_RUNS} runs"
    if not done:
        return Check(text, "not measured", False)
    return Check(text, f"{sum(done)} of {len(done)}", sum(done) * OF_RUNS >= wanted * len(done))


def _calm(where: str, members: Sequence[Row]) -> Check:
    text = f"{where}: wall force below {CALM_N:g} N for {CALM_PERCENT:g} % of the time of every run"
    if not members:
        return Check(text, "not measured", False)
    shares = [row["calm_percent"] for row in members]
    value = f"{min(shares):.2f} % in the worst run, {np.mean(shares):.2f} % in the mean{_missed(members)}"
    return Check(text, value, min(shares) >= CALM_PERCENT and _complete(members))


def _fewer_steps(learned: Sequence[Row], hand_made: Sequence[Row]) -> Check:
    """A run that never got there counts as one step more than it had, the least that it can be.

    That favours the hand-made reward; so with the learned one, every run has to get there.
    """
    text = f"learned reward: {100 * SUCCESS:g} % success in fewer environment steps than the hand-made one"
    if not (learned and hand_made):
        return Check(text, "not measured", False)
    means, parts = [], []
    for name, members in (("learned", learned), ("hand-made", hand_made)):
        steps = [row["steps_to_success"] or row["env_steps"] + 1 for row in members]
        n_never = sum(row["steps_to_success"] is None for row in members)
        means.append(np.mean(steps))
        more = f" or more: never in {n_never} of {len(members)} runs" if n_never else ""
        parts.append(f"{name} {means[-1]:,.0f} in the mean{more}")
    always = all(row["steps_to_success"] is not None for row in learned)
    return Check(text, "; ".join(parts), always and bool(means[0] < means[1]))


def _circle(members: Sequence[Row], without: Sequence[Row]) -> Check:
    text = "circle: mean translation with demonstrations not above that without"
    if not (members and without):
        return Check(text, "not measured", False)
    means = [float(np.mean([row["translation_mm"] for row in of])) for of in (members, without)]
    everyone = [*members, *({**row, "positions": row["points"]} for row in without)]
    value = f"{means[0]:.2f} mm with, {means[1]:.2f} mm without{_missed(everyone)}"
    return Check(text, value, means[0] <= means[1] and _complete(everyone))


def _kept(success: Sequence[Sequence[float] | None]) -> Check:
    """What was learned in the first stage, after the second; without success there is nothing to keep."""
    text = "circle: success at the first stage's points after stage two not lower than before, in every run"
    if not success or None in success:
        return Check(text, "not measured", False)
    after = np.array(success)  # (runs, 2)
    lower = int(np.sum(after[:, 1] < after[:, 0]))
    one, two = 100 * after.mean(axis=0)
    value = f"{one:.1f} % after stage one, {two:.1f} % after stage two; lower in {lower} of {len(after)} runs"
    return Check(text, value, lower == 0 and bool(one > 0))
