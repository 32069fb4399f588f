"""What the open-space experiments gave: JSON, pictures, one HTML page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.paper.measure import Followed
from benchmarks.paper.plots import circle_figure, error_figure, loads_figure, trace_figure
from benchmarks.paper.report import (
    Drawn,
    calibration_of,
    calibration_part,
    film_part,
    first_of_page,
    goals_part,
    keep_film,
    save_picture,
    write_figures,
)
from benchmarks.paper.stages import EVALUATION_FILE, METHODS, Case, Settings, policy_folder
from benchmarks.paper.summary import (
    AVERAGED,
    PAPER_SIMULATED_MM,
    Check,
    check_goals,
    rows,
    spread,
    summarise,
)
from calib.report.page import Section, Table, page
from mjx_softarm.spec import ArmSpec

JSON_FILE, HTML_FILE, FILM_FILE = "paper-open.json", "report.html", "circle.gif"
HEADINGS = {
    "translation_mm": "translation [mm]",
    "rmse_mm": "RMSE [mm]",
    "max_mm": "largest [mm]",
    "yaw_deg": "yaw [deg]",
    "pitch_deg": "pitch [deg]",
    "roll_deg": "roll [deg]",
    "believed_mm": "as estimated [mm]",
    "saturated_points": "points with a saturated chamber",
    "saturated_chambers_max": "saturated chambers of a point, largest",
    "saturation_events": "saturation told by the loop",
}


def write_results(
    folder: Path,
    pictures: Path,
    settings: Settings,
    results: Mapping[Case, Followed],
    no_film: str,
    provenance: dict[str, Any],
) -> dict[str, Any]:
    """Write the page and the JSON file; returns what is in the JSON file.

    Args:
        folder: of the benchmark, with policies and calibrations; the page goes there.
        pictures: where JSON file, pictures and film go.
        settings: of the benchmark.
        results: of all cases.
        no_film: why there is no film, or "".
        provenance: versions, machine and commit.
    """
    data = figures_of(folder, settings, results)
    drawn = draw(results, data["runs"])
    pictures.mkdir(parents=True, exist_ok=True)
    kept = ["circle", "error", "loads", *(f"pressures-{load_g}g" for load_g in settings.loads_g[-2:])]
    for name in kept:
        save_picture(pictures / f"paper-{name}.png", drawn[name][1])
    film = keep_film(folder / FILM_FILE, no_film, pictures / f"paper-{FILM_FILE}")
    write_figures(pictures / JSON_FILE, data, provenance)
    text = to_html(data, drawn, film, no_film, provenance)
    (folder / HTML_FILE).write_text(text, "utf-8")
    return data


def figures_of(folder: Path, settings: Settings, results: Mapping[Case, Followed]) -> dict[str, Any]:
    """All figures: goals, spreads, simulated errors, calibrations, every run."""
    table = rows(results)
    return {
        "arm": "twin",
        "settings": {**settings.fixed(), "twins": list(settings.twins), "seeds": list(settings.seeds)},
        "goals": [check._asdict() for check in check_goals(table)],
        "spreads": summarise(table),
        "simulated": simulated(folder, settings, table),
        "calibrations": {f"twin {twin}": calibration_of(folder, twin) for twin in settings.twins},
        "runs": table,
    }


def simulated(folder: Path, settings: Settings, table: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Each policy's mean error on the circle in its own simulation, beside that on the twins."""
    found = []
    for twin in (None, *settings.twins):
        method = "without" if twin is None else "with"
        for seed in settings.seeds:
            file = policy_folder(folder, twin, seed) / EVALUATION_FILE
            on_twins = [
                row["translation_mm"]
                for row in table
                if (row["method"], row["seed"], row["load_g"]) == (method, seed, 0)
                and twin in (None, row["twin"])
            ]
            found.append(
                {
                    "method": method,
                    "twin": twin,
                    "seed": seed,
                    "simulated_mm": json.loads(file.read_text("utf-8"))["circle_mean_mm"],
                    "on_twin_mm": spread(on_twins)._asdict(),
                }
            )
    return found


def draw(
    results: Mapping[Case, Followed], table: Sequence[Mapping[str, Any]]
) -> dict[str, tuple[str, Figure]]:
    """Name -> what is shown, and the drawing."""
    chambers = ArmSpec.default().chambers
    limits_kpa = (chambers.pressure_min_kpa, chambers.pressure_max_kpa)
    drawn = {
        "circle": ("Circle from above, first seed, no load (twins)", circle_figure(results)),
        "error": ("Error at each point: mean and range over twins and seeds, no load", error_figure(results)),
        "loads": ("Unknown loads, with S2R: every run and the mean (twins)", loads_figure(table)),
    }
    first = min((case for case in results if case.method == "with"), key=lambda case: (case.twin, case.seed))
    for load_g in sorted({case.load_g for case in results if case.load_g}):
        followed = results[first._replace(load_g=load_g)]
        text = f"Springs and pressures with {load_g} g, twin {first.twin}, seed {first.seed}"
        drawn[f"pressures-{load_g}g"] = (text, trace_figure(followed, limits_kpa))
    return drawn


def to_html(
    data: Mapping[str, Any],
    drawn: Drawn,
    film: Path | None,
    no_film: str,
    provenance: dict[str, Any],
) -> str:
    """The page; it needs no other file."""
    checks = [Check(**check) for check in data["goals"]]
    traces = tuple(item for name, item in drawn.items() if name.startswith("pressures"))
    parts = (
        goals_part(checks),
        _circle_part(data, (drawn["circle"], drawn["error"])),
        _loads_part(data, (drawn["loads"], *traces)),
        _simulated_part(data),
        calibration_part(data["calibrations"]),
        Section("Every run", "Mean over the points arrived at.", (_runs_table(data["runs"]),)),
    )
    film_html = film_part(film, no_film, "The twin on the circle")
    title = "The paper's open-space experiments"
    return page(title, first_of_page(checks), parts, film_html, provenance)


def _circle_part(data: Mapping[str, Any], drawn: tuple[tuple[str, Figure], ...]) -> Section:
    text = (
        "Mean ± standard deviation over twins and training seeds; errors by motion capture at rest, averaged "
        "over half a second. Without S2R, only the springs are calibrated. Gradient descent has no "
        "training seed and runs once for each twin."
    )
    unloaded = [item for item in data["spreads"] if item["load_g"] == 0]
    return Section("Circle", text, (_spreads_table(unloaded),), figures=drawn)


def _loads_part(data: Mapping[str, Any], drawn: tuple[tuple[str, Figure], ...]) -> Section:
    text = (
        "The policy with S2R, which knows of no load. Solid: springs as read and pressures as measured; "
        "shaded: points at which a chamber is saturated."
    )
    loaded = [item for item in data["spreads"] if item["method"] == "with"]
    return Section("Unknown loads", text, (_spreads_table(loaded),), figures=drawn)


def _spreads_table(spreads: Sequence[Mapping[str, Any]]) -> Table:
    head = ["", "load [g]", "runs"]
    for name in AVERAGED:
        head.append(f"twin: {HEADINGS[name]}")
        if any(name in item["paper"] for item in spreads):
            head.append("paper")
    body = []
    for item in spreads:
        row = [METHODS[item["method"]], item["load_g"], item["runs"]]
        for name in AVERAGED:
            row.append(f"{item[name]['mean']:.2f} ± {item[name]['std']:.2f}")
            if any(name in other["paper"] for other in spreads):
                row.append(item["paper"].get(name, "-"))
        body.append(tuple(row))
    return Table(tuple(head), tuple(body))


def _simulated_part(data: Mapping[str, Any]) -> Section:
    text = f"Mean error on the circle; the paper's, without S2R: {PAPER_SIMULATED_MM:g} mm in simulation."
    body = tuple(
        (
            METHODS[item["method"]],
            "all" if item["twin"] is None else item["twin"],
            item["seed"],
            item["simulated_mm"],
            item["on_twin_mm"]["mean"],
        )
        for item in data["simulated"]
    )
    head = ("policy", "twin", "seed", "simulated [mm]", "on the twin [mm]")
    return Section("Simulated against twin", text, (Table(head, body),))


def _runs_table(table: Sequence[Mapping[str, Any]]) -> Table:
    names = ("reached", *AVERAGED, "seconds")
    head = ("", "twin", "seed", "load [g]", *(HEADINGS.get(name, name) for name in names), "told by the loop")
    body = []
    for row in table:
        told = ", ".join(f"{name}: {n}" for name, n in row["events"].items()) or "-"
        start = (METHODS[row["method"]], row["twin"], row["seed"], row["load_g"])
        body.append((*start, *(row[name] for name in names), told))
    return Table(head, tuple(body))
