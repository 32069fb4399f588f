"""Report of an experiment: figures of each trial, spreads over runs, targets and pictures.

Targets were set before anything was measured. A trial that missed a goal meets none of errors and times.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness.common import Row, over_runs, save, target
from benchmarks.paper import independence, pictures
from benchmarks.paper.trials import KINDS, POLICY_FILE, Settings, run_path, trials
from calib.read.logs import read_log
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.policy.file import load_policy

DPI = 110
FIGURES = {  # with a spread over runs
    "open": (
        *("translation_mm", "rmse_mm", "max_mm", "yaw_deg", "pitch_deg", "roll_deg", "believed_mm"),
        *("saturated_points", "load_off_g", "way_mm", "seconds"),
    ),
    "confined": (
        *("x_mm", "y_mm", "z_mm", "translation_mm", "max_mm"),
        *("done", "calm_percent", "wall_max_n", "seconds"),
    ),
}
N_OPERATIONS = 4


class Target(NamedTuple):
    """Limit of a figure over the runs of a kind."""

    kind: str  # "": all
    variants: tuple[str, ...]  # (): all with stops
    figure: str  # of a trial, or one of `counts`
    limit: float  # largest value
    over: Callable[[Any], Any] = np.mean
    at_least: bool = False  # the limit is a least value
    of: tuple[str, str] | None = None  # kind and variant by whose mean the value is divided
    strict: bool = True  # not met where a goal was missed

    def check(self, table: Sequence[Row]) -> dict[str, str]:
        """Return a row for the target; what was not measured is not met."""
        rows = [row for row in table if self._includes(row)]
        bound = f"at {'least' if self.at_least else 'most'} {self.limit:.3g}"
        where = ", ".join([KINDS[self.kind].title if self.kind else "all kinds", *self.variants])
        relative = f" over the mean of {KINDS[self.of[0]].title}, {self.of[1]}" if self.of else ""
        text = f"{where}: {self.over.__name__} of {self.figure}{relative}: {bound}"
        others = [row[self.figure] for row in table if (row["kind"], row["variant"]) == self.of]
        if not rows or (self.of and not others):
            return target(text, "not measured", False)
        value = float(self.over([row[self.figure] for row in rows]))
        value /= float(np.mean(others)) if others else 1.0
        n_missed = sum(row["missed"] for row in rows) if self.strict else 0
        measured = f"{value:.4g}" + f", {n_missed} points missed" * bool(n_missed)
        met = value >= self.limit if self.at_least else value <= self.limit
        return target(text, measured, met and not n_missed)

    def _includes(self, row: Row) -> bool:
        variant = row["variant"] in self.variants if self.variants else not row["lap_s"]
        return not self.kind or (row["kind"] == self.kind and variant)


def both_orders(done: Sequence[bool]) -> float:
    """Return the share of runs that do all operations with the objects as shown and exchanged."""
    return float(np.reshape(done, (-1, 2)).all(axis=1).mean())


def payload_targets(kind: str) -> list[Target]:
    """Return the targets of a policy that carries payloads."""
    return [
        Target(kind, ("500 g",), "translation_mm", 2.5),
        Target(kind, ("1000 g",), "translation_mm", 4.0),
        Target(kind, ("1000 g",), "max_mm", 12.0, np.max),
        Target(kind, (), "load_off_g", 100.0),
        Target(kind, ("1000 g",), "overloaded", 0, np.sum, strict=False),
    ]


def open_targets(settings: Settings) -> list[Target]:
    """Return the targets in open space."""
    unloaded, heavy, lap_mm = ("0 g",), ("1000 g",), {"twin": 2.1, "rod": 2.5}[settings.arm]
    return [
        Target("with", unloaded, "translation_mm", 1.5),
        *(Target("with", unloaded, f"{angle}_deg", 3.0) for angle in ("yaw", "pitch", "roll")),
        Target("without", unloaded, "translation_mm", 2.0, at_least=True, of=("with", "0 g")),
        *payload_targets("with"),
        *(payload_targets("payload") if "payload" in settings.beside else ()),
        Target("with", ("0 g in 20 s",), "way_mm", lap_mm),
        Target("with", heavy, "saturation_events", 1, np.sum, at_least=True, strict=False),
        Target("with", heavy, "unreported", 0, np.sum, strict=False),
        Target("with", unloaded, "saturated_points", 0, np.sum),
        Target("gradient", unloaded, "saturated_points", 1, np.sum, at_least=True, strict=False),
        Target("", (), "missed", 0, np.sum, strict=False),
    ]


def confined_targets() -> list[Target]:
    """Return the targets in pipes."""
    shown, exchanged, moving = "as shown", "exchanged", "as shown in motion"
    share: Any = {"at_least": True, "strict": False}
    return [
        *(Target("pipe", (shown,), f"{axis}_mm", 5.0) for axis in "xyz"),
        Target("pipe", (shown, exchanged), "all_done", 8 / 9, both_orders, **share),
        Target("narrow-learned", (shown,), "all_done", 7 / 9, **share),
        Target("pipe", (moving,), "all_done", 8 / 9, **share),
        Target("pipe", (moving,), "seconds", 0.5, of=("pipe", shown)),
        Target("pipe", (shown, exchanged), "calm_percent", 99.0, np.min, at_least=True),
        Target("pipe", (moving,), "calm_percent", 99.0, np.min, at_least=True),
        Target("narrow-learned", (shown,), "calm_percent", 99.0, np.min, at_least=True),
    ]


def counts(row: Row) -> dict[str, Any]:
    """Return what targets count in a trial."""
    return {
        "missed": row["points"] - row["measured"],
        "all_done": row["done"] == row["operations"] == N_OPERATIONS,
        "overloaded": Fault.OVERLOADED.value in row["events"],
        "unreported": row["saturated_points"] > 0 and not row["saturation_events"],  # a saturated chamber
    }


def write_report(experiment: str, folder: Path, results: Path, settings: Settings) -> dict[str, Any]:
    """Write JSON file and pictures of an experiment to the folder `results`; return the figures."""
    label = "rod" if settings.arm == "rod" else experiment
    if experiment == "independence":
        data = independence.figures_of(folder, settings)
    else:
        files = [folder / trial.result for trial in trials(experiment, settings)]
        rows = [json.loads(file.read_text("utf-8")) for file in files]
        at_stops = [row.pop("at_stops") for row in rows]
        data = figures_of(experiment, settings, rows)
        if experiment == "open":
            prefix = "paper" if label == "open" else f"paper-{label}"
            data["laps"] = _draw(folder, results / prefix, settings, rows, at_stops)
    finite = json.loads(json.dumps(data), parse_constant=lambda _: None)  # JSON has no NaN
    print(f"written: {save(f'paper-{label}', finite, results)}")
    return data


def figures_of(experiment: str, settings: Settings, rows: Sequence[Row]) -> dict[str, Any]:
    """Return all figures: targets, spreads, and every run."""
    table = [{**row, **counts(row)} for row in rows]
    targets = open_targets(settings) if experiment == "open" else confined_targets()
    return {
        "targets": [one.check(table) for one in targets],
        "settings": dataclasses.asdict(settings),
        "spreads": over_runs(table, ("kind", "variant"), FIGURES[experiment]),
        "runs": table,
    }


def _draw(
    folder: Path, prefix: Path, settings: Settings, rows: Sequence[Row], at_stops: Sequence[Row]
) -> list[dict[str, Any]]:
    """Draw pictures of open space into files that begin with `prefix`; return figures of the laps drawn."""
    first = (settings.twins[0], settings.seeds[0])
    spec = load_policy(folder / run_path("with", *first) / POLICY_FILE).spec
    drawn = [trial for trial in trials("open", settings) if trial.logged and trial[1:3] == first]
    logs = {trial.load_g: read_log(folder / trial.log, spec)[0] for trial in drawn}
    figures = {
        "circle": pictures.circle_figure(rows, at_stops, settings),
        "loads": pictures.loads_figure(rows, settings.arm),
        "traces": pictures.traces_figure(logs, spec),
    }
    for name, figure in figures.items():
        figure.savefig(prefix.with_name(f"{prefix.name}-{name}.png"), dpi=DPI)
    return [{"load_g": load_g, **pictures.at_limits(log, spec)} for load_g, log in logs.items()]
