"""Report of an experiment: a row for each trial, spreads over runs, targets, pictures and a film.

Targets were set before anything was measured. A trial that missed a goal meets none, however small its error.
"""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from benchmarks.harness.common import grouped, save, target
from benchmarks.harness.stages import load_arrays
from benchmarks.paper import independence, pictures
from benchmarks.paper.jobs import scene_of
from benchmarks.paper.trial import CALM_N, TrialOutcome, figures
from benchmarks.paper.trials import (
    CALIBRATION,
    KINDS,
    POLICY_FILE,
    Settings,
    Trial,
    arm_name,
    filmed,
    run_path,
    s2r_path,
    traced,
    trials,
)
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.mechanics.drawing.render import RenderError

DPI, N_COLOURS = 110, 64
PREFIXES = {"open": "paper", "rod": "paper-rod", "confined": "paper-confined"}  # of pictures beside the JSON
FILMS = {"open": "circle.gif", "confined": "pipe.gif"}
FIGURES = (  # with a spread over runs
    *("translation_mm", "rmse_mm", "max_mm", "x_mm", "y_mm", "z_mm", "yaw_deg", "pitch_deg", "roll_deg"),
    *("believed_mm", "saturated_points", "saturated_chambers_max", "saturation_events", "way_mm", "done"),
    *("calm_percent", "wall_max_n", "load_off_g", "seconds"),
)
COLUMNS = {  # figures in the printed table
    "open": (
        *("translation_mm", "rmse_mm", "max_mm", "yaw_deg", "pitch_deg", "roll_deg"),
        *("saturated_points", "load_off_g", "way_mm", "seconds"),
    ),
    "confined": (
        *("x_mm", "y_mm", "z_mm", "translation_mm", "max_mm"),
        *("done", "calm_percent", "wall_max_n", "seconds"),
    ),
}
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
}
PAPER_LOADS_MM, PAPER_HEAVY_MAX_MM = 9.0, 23.76  # mean translation up to LIGHT_G, largest at HEAVY_G
PAPER_POINTS = ((35, PAPER_LOADS_MM), (LIGHT_G, PAPER_LOADS_MM), (HEAVY_G, PAPER_HEAVY_MAX_MM))
CALM_PERCENT = 99.0
# Least numbers of nine runs; for other numbers of runs, the same share
WIDE_RUNS, NARROW_RUNS, OF_RUNS = 8, 7, 9
IN_TIME_MM = {"twin": 2.1, "rod": 2.5}  # largest mean on a lap of `LAP_S`
LAP_S = 20.0
ANGLES = ("yaw", "pitch", "roll")

Row = Mapping[str, Any]
Check = dict[str, str]  # a row of `target`


def write_report(experiment: str, folder: Path, results: Path, settings: Settings) -> dict[str, Any]:
    """Write JSON file, pictures and film of an experiment to the folder `results`; return the figures."""
    label = settings.arm if (experiment, settings.arm) == ("open", "rod") else experiment
    if experiment == "independence":
        data = independence.figures_of(folder, settings)
    else:
        listed = trials(experiment, settings)
        outcomes = {trial: load_arrays(TrialOutcome, folder / trial.result) for trial in listed}
        data = figures_of(experiment, folder, settings, outcomes)
        _draw(experiment, folder, results / PREFIXES[label], settings, outcomes, data)
    finite = json.loads(json.dumps(data), parse_constant=lambda _: None)  # JSON has no NaN
    print(f"written: {save(f'paper-{label}', finite, results)}")
    return data


def _draw(
    experiment: str,
    folder: Path,
    prefix: Path,
    settings: Settings,
    outcomes: Mapping[Trial, TrialOutcome],
    data: dict[str, Any],
) -> None:
    """Write pictures and film of an experiment, to files whose names begin with `prefix`."""
    # Pictures of open space; the laps of some payloads add figures
    prefix.parent.mkdir(parents=True, exist_ok=True)
    if experiment == "open":
        from calib.read.logs import read_log
        from mjx_softarm.policy.file import load_policy

        first = filmed(experiment, settings)
        spec = load_policy(folder / run_path("with", first.twin, first.seed) / POLICY_FILE).spec
        logs = {trial.load_g: read_log(folder / trial.log, spec)[0] for trial in traced(settings)}
        data["S2R at held-out poses"] = [
            {"twin": twin, "network": name, **errors}
            for twin in settings.twins
            for name, errors in json.loads((folder / s2r_path(twin)).read_text("utf-8")).items()
        ]
        data["laps"] = [{"load_g": load_g, **pictures.at_limits(log, spec)} for load_g, log in logs.items()]
        _save_picture(prefix, "circle.png", pictures.circle_figure(outcomes, settings.arm))
        _save_picture(prefix, "loads.png", pictures.loads_figure(data["runs"], settings.arm, PAPER_POINTS))
        _save_picture(prefix, "traces.png", pictures.traces_figure(logs, spec))
    # A film; a rod cannot be drawn
    film = prefix.with_name(f"{prefix.name}-{FILMS[experiment]}")
    if settings.arm == "twin":
        trial = filmed(experiment, settings)
        try:
            pictures.film(film, scene_of(folder, settings, trial), trial)
        except RenderError as error:
            print(f"no film: {error}")


def _save_picture(prefix: Path, name: str, figure: Figure) -> None:
    """Write a drawing as PNG with few colours, which halves its size."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    image = Image.open(buffer).convert("RGB").quantize(N_COLOURS, Image.Quantize.MAXCOVERAGE)
    image.save(prefix.with_name(f"{prefix.name}-{name}"), format="PNG", optimize=True)


def figures_of(
    experiment: str, folder: Path, settings: Settings, outcomes: Mapping[Trial, TrialOutcome]
) -> dict[str, Any]:
    """Return all figures: targets, spreads, warnings of calibrations, and every run."""
    table = trial_rows(outcomes)
    calibrations = {}
    for twin in settings.twins:
        report = json.loads((folder / arm_name(twin) / CALIBRATION / "report.json").read_text("utf-8"))
        calibrations[f"twin {twin}"] = {title: part["warnings"] for title, part in report["parts"].items()}
    return {
        "arm": settings.arm,
        "targets": _open(table, settings.arm) if experiment == "open" else _confined(table),
        "settings": dataclasses.asdict(settings),
        "spreads": spreads(table),
        "calibrations": calibrations,
        "runs": table,
    }


def trial_rows(outcomes: Mapping[Trial, TrialOutcome]) -> list[dict[str, Any]]:
    """Return a row of figures for each trial."""
    return [
        {
            **trial._asdict(),
            "variant": trial.variant,
            **figures(outcome),
            "load_off_g": load_off_g(trial, outcome),
        }
        for trial, outcome in outcomes.items()
    ]


def load_off_g(trial: Trial, outcome: TrialOutcome) -> float:
    """Return the mean error of the loop's payload estimate over the goals; NaN in a pipe."""
    seen_g = outcome.load_estimate_g[np.isfinite(outcome.load_estimate_g)]
    return float(np.abs(seen_g - trial.load_g).mean()) if len(seen_g) and not trial.objects else np.nan


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
            "all_done_runs": sum(map(_all_done, rows)),
            **{name: _spread([row[name] for row in rows]) for name in FIGURES},
            "paper": paper_numbers(kind, variant, load_g),
        }
        for (kind, load_g, variant), rows in sorted(groups.items())
    ]


def _spread(values: Sequence[float]) -> dict[str, float]:
    """Return mean, standard deviation (of the runs), minimum and maximum; NaN where any value is NaN."""
    x = np.asarray(values, float)
    return {"mean": float(x.mean()), "std": float(x.std()), "min": float(x.min()), "max": float(x.max())}


def _all_done(row: Row) -> bool:
    """Return whether a trial did all the operations of its task."""
    return row["done"] == row["operations"] == N_OPERATIONS


def paper_numbers(kind: str, variant: str, load_g: int = 0) -> dict[str, float]:
    """Return the paper's numbers for its physical arm; none for gradient descent."""
    if load_g and kind == "with":
        return {"translation_mm": PAPER_LOADS_MM} if load_g <= LIGHT_G else {"max_mm": PAPER_HEAVY_MAX_MM}
    return dict(PAPER.get((kind, variant), {}))


def printed_rows(experiment: str, data: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return spreads as mean ± deviation, each followed by the paper's numbers where it has any."""
    if experiment == "independence":
        return data["under loads"]
    rows = []
    for item in data["spreads"]:
        cells = {name: f"{item[name]['mean']:.2f} ± {item[name]['std']:.2f}" for name in COLUMNS[experiment]}
        rows.append({"kind": KINDS[item["kind"]].title, "variant": item["variant"], "runs": item["runs"]})
        rows[-1] |= cells
        if item["paper"]:
            rows.append({"kind": "the paper's arm", **item["paper"]})
    return rows


def _open(table: Sequence[Row], arm: str) -> list[Check]:
    """Check the targets in open space."""
    # Runs with S2R without and with a load, with calibrated springs alone, and by gradient descent
    unloaded, without, gradient = (_select(table, kind, "0 g") for kind in ("with", "without", "gradient"))
    carried = [row for row in table if row["kind"] == "with" and not row["lap_s"]]
    observed = [row for row in table if row["kind"] == "payload"]
    heavy = [row for row in carried if row["load_g"] == HEAVY_G]
    in_time = _select(table, "with", f"0 g in {LAP_S:g} s")
    # Saturated points and missed goals
    silent = sum(row["saturated_points"] > 0 and not row["saturation_events"] for row in heavy)
    reported = sum(row["saturation_events"] > 0 for row in heavy)
    reports = f"reported in {reported} of {len(heavy)} runs; in {silent}, a saturated chamber was not"
    n_free = np.sum(_values(unloaded, "saturated_points"))
    at_points = _values(gradient, "saturated_points")
    hits = f"{np.sum(at_points):g} points, in {np.count_nonzero(at_points)} of {len(gradient)} runs"
    ratio = _mean(without, "translation_mm") / _mean(unloaded, "translation_mm")
    better = "translation with calibrated springs over that with S2R, at least 2"
    free = "with S2R, unloaded: no saturated chamber at any point"
    n_missed, n_incomplete = _missed(table)
    missed = f"{n_missed} points missed, in {n_incomplete} of {len(table)} runs"
    return [
        _at_most("with S2R, mean translation", "mm", 1.5, unloaded, "translation_mm"),
        *(_at_most(f"with S2R, mean {x}", "deg", 3.0, unloaded, f"{x}_deg") for x in ANGLES),
        _reaching(better, f"{ratio:.2f}", ratio >= 2, without, unloaded),
        *_loaded("", carried),
        *(_loaded(" observed", observed) if observed else ()),
        _at_most(f"with S2R, once around in {LAP_S:g} s, mean", "mm", IN_TIME_MM[arm], in_time, "way_mm"),
        _check("1 kg, saturation detected and reported by the loop", reports, reported > 0 == silent, heavy),
        _reaching(free, f"{n_free:g} points of {len(unloaded)} runs", not n_free, unloaded),
        _check("gradient descent saturates at least one chamber", hits, np.any(at_points), gradient),
        _check("every point of every run is reached", missed, not n_missed, table),
    ]


def _loaded(how: str, rows: Sequence[Row]) -> list[Check]:
    """Check the targets for payloads; the policies are those of `rows`."""
    light, heavy = ([row for row in rows if row["load_g"] == load_g] for load_g in (LIGHT_G, HEAVY_G))
    overloaded = sum(Fault.OVERLOADED.value in row["events"] for row in heavy)
    none = f"1 kg{how}, the largest payload: no run reported to be overloaded"
    return [
        _at_most(f"{LIGHT_G} g{how}, mean translation", "mm", 2.5, light, "translation_mm"),
        _at_most(f"1 kg{how}, mean translation", "mm", 4.0, heavy, "translation_mm"),
        _at_most(f"1 kg{how}, largest translation of all runs", "mm", 12.0, heavy, "max_mm", np.max),
        _at_most(f"payload{how}, estimated, mean error at all loads", "g", 100.0, rows, "load_off_g"),
        _check(none, f"{overloaded} of {len(heavy)} runs", not overloaded, heavy),
    ]


def _confined(table: Sequence[Row]) -> list[Check]:
    """Check the targets in pipes."""
    # Runs in the wide pipe with stops and without, and in the narrow one
    shown, exchanged = _select(table, "pipe", "as shown"), _select(table, "pipe", "exchanged")
    moving, narrow = _select(table, "pipe", "as shown in motion"), _select(table, "narrow", "as shown")
    # Their time, and operations done by policies with both orders of objects
    ratio = _mean(moving, "seconds") / _mean(shown, "seconds")
    done = {(row["twin"], row["seed"]): _all_done(row) for row in exchanged}
    both = [_all_done(row) and done.get((row["twin"], row["seed"]), False) for row in shown]
    motion, four = "300 mm pipe, in motion", "300 mm pipe: all four operations done, as shown and exchanged"
    return [
        *(
            _at_most(f"300 mm pipe: mean absolute error in {axis} at the goals", "mm", 5.0, shown, name)
            for axis, name in (("X", "x_mm"), ("Y", "y_mm"), ("Z", "z_mm"))
        ),
        _share_done(four, WIDE_RUNS, both, exchanged),
        _share_done("250 mm pipe: both tasks done", NARROW_RUNS, list(map(_all_done, narrow)), narrow),
        _share_done(f"{motion}: all four operations done", WIDE_RUNS, list(map(_all_done, moving)), moving),
        _reaching(f"{motion}: time over that with stops, at most 0.5", f"{ratio:.2f}", ratio <= 0.5, moving),
        _calm("300 mm pipe, as shown and exchanged", shown, exchanged),
        _calm(motion, moving),
        _calm("250 mm pipe", narrow),
    ]


def _check(text: str, value: str, met: Any, *groups: Sequence[Any]) -> Check:
    """Return a check of groups of rows; not measured, and so not met, where one is empty."""
    return target(text, value, bool(met)) if all(groups) else target(text, "not measured", False)


def _reaching(text: str, value: str, met: Any, *groups: Sequence[Row]) -> Check:
    """Return a check that is not met where a goal was missed."""
    rows = [row for group in groups for row in group]
    n, n_runs = _missed(rows)
    missed = f", {n} points missed in {n_runs} of {len(rows)} runs" if n else ""
    return _check(text, value + missed, met and not n, *groups)


def _missed(rows: Sequence[Row]) -> tuple[int, int]:
    """Return the number of missed goals, and of the runs that missed any."""
    missed = [row["points"] - row["measured"] for row in rows]
    return sum(missed), sum(n > 0 for n in missed)


def _select(table: Sequence[Row], kind: str, variant: str) -> list[Row]:
    return [row for row in table if (row["kind"], row["variant"]) == (kind, variant)]


def _values(rows: Sequence[Row], name: str) -> np.ndarray:
    """Return a figure (n,) of each row; one NaN without any, for a value that is not shown."""
    return np.array([row[name] for row in rows] or [np.nan], float)


def _mean(rows: Sequence[Row], name: str) -> float:
    return float(np.mean(_values(rows, name)))


def _at_most(
    text: str, unit: str, limit: float, rows: Sequence[Row], name: str, over: Callable[[Any], Any] = np.mean
) -> Check:
    value = float(over(_values(rows, name)))
    return _reaching(f"{text} at most {limit:g} {unit}", f"{value:.2f} {unit}", value <= limit, rows)


def _share_done(text: str, least: int, done: Sequence[bool], rows: Sequence[Row]) -> Check:
    text = f"{text}, in at least {least} of {OF_RUNS} runs"
    return _check(text, f"{sum(done)} of {len(done)}", sum(done) * OF_RUNS >= least * len(done), done, rows)


def _calm(where: str, *groups: Sequence[Row]) -> Check:
    text = f"{where}: wall force below {CALM_N:g} N for {CALM_PERCENT:g} % of the time of every run"
    shares = _values([row for rows in groups for row in rows], "calm_percent")
    value = f"{min(shares):.2f} % in the worst run, {np.mean(shares):.2f} % in the mean"
    return _reaching(text, value, min(shares) >= CALM_PERCENT, *groups)
