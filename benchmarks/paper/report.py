"""Report of an experiment: JSON, pictures, film, and one HTML page."""

from __future__ import annotations

import base64
import html
import io
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image

from benchmarks.paper import plots
from benchmarks.paper.engine import Settings
from benchmarks.paper.goals import check_goals
from benchmarks.paper.jobs import CALIBRATION
from benchmarks.paper.kinds import KINDS, Trial
from benchmarks.paper.summary import (
    FIGURES,
    PAPER_SIMULATED_MM,
    SUCCESS,
    Results,
    simulated_rows,
    spreads,
    training_rows,
    trial_rows,
)
from benchmarks.paper.trials import FILMS, filmed
from calib.report.page import Section, Table, page
from mjx_softarm._support.provenance import write_json
from mjx_softarm.spec import ArmSpec

DPI, N_COLOURS = 110, 64
PAGES = {"open": "report.html", "confined": "confined.html"}
TITLES = {
    "open": "The paper's open-space experiments",
    "confined": "The paper's experiments in confined spaces",
}
PREFIXES = {"open": "paper", "confined": "paper-confined"}  # of files beside the JSON
COLUMNS = {  # figures in the tables, keys of FIGURES
    "open": (
        *("translation_mm", "rmse_mm", "max_mm", "yaw_deg", "pitch_deg", "roll_deg", "believed_mm"),
        *("saturated_points", "saturated_chambers_max", "saturation_events"),
    ),
    "confined": (
        *("x_mm", "y_mm", "z_mm", "translation_mm", "max_mm", "saturated_points", "done"),
        *("calm_percent", "wall_max_n", "container_max_n"),
    ),
}
HEADINGS = {  # of other columns
    "kind": "",
    "variant": "load or objects",
    "events": "faults reported",
    "all_done_runs": "runs with all operations done",
    "simulated_mm": "simulated [mm]",
    "on_twin_mm": "on the twin [mm]",
    "steps_to_success": f"steps to {100 * SUCCESS:g} % success",
    "stages_first_success": "success of the first stage as it ended, and at the end",
}

Row = Mapping[str, Any]
Drawn = Mapping[str, tuple[str, Figure]]  # name -> caption and drawing


def write_report(
    experiment: str,
    folder: Path,
    pictures: Path,
    settings: Settings,
    results: Results,
    no_film: str,
    provenance: dict[str, Any],
) -> dict[str, Any]:
    """Write page, JSON, pictures and film; returns the figures.

    Args:
        experiment: key of PAGES.
        folder: of the benchmark, with policies and calibrations; the page goes there.
        pictures: folder for JSON file, pictures and film.
        settings: of the benchmark.
        results: of all trials and trainings.
        no_film: why there is no film, or "".
        provenance: versions, machine and commit.
    """
    data = figures_of(experiment, folder, settings, results)
    drawn = draw(experiment, settings, results, data["runs"])
    pictures.mkdir(parents=True, exist_ok=True)
    # JSON, which has no NaN, pictures and film.
    finite = json.loads(json.dumps(data), parse_constant=lambda _: None)
    write_json(pictures / f"paper-{experiment}.json", {"figures": finite, **provenance})
    prefix, film = PREFIXES[experiment], folder / FILMS[experiment]
    for name, (_, figure) in drawn.items():
        _save_picture(pictures / f"{prefix}-{name}.png", figure)
    film_html = f"<p>None: {html.escape(no_film)}</p>"
    if film.exists():
        shutil.copyfile(film, pictures / f"{prefix}-{film.name}")
        encoded = base64.b64encode(film.read_bytes()).decode()
        film_html = f'<p><img alt="The twin, filmed" src="data:image/gif;base64,{encoded}"></p>'
    # Page.
    missed = [f"{check['text']}: {check['value']}" for check in data["goals"] if not check["met"]]
    verdict = f"{len(missed)} of {len(data['goals'])} goals are not met." if missed else "Every goal is met."
    first = (
        "<p>All measured on simulated arms called twins; no number is of a real arm.</p>"
        f'<p class="{"bad" if missed else "good"}">{verdict}</p>'
    )
    goals = [{**goal, "met": "met" if goal["met"] else "NOT MET"} for goal in data["goals"]]
    warnings = tuple(
        f"{twin}: {title}: {warning}"
        for twin, steps in data["calibrations"].items()
        for title, found in steps.items()
        for warning in found
    )
    columns = ("kind", "variant", "twin", "seed", "reached", *COLUMNS[experiment], "seconds", "events")
    sections = (
        Section(
            "Goals",
            "Set before anything was measured.",
            (_table(goals, ("text", "value", "met")),),
            tuple(f"not met: {text}" for text in missed),
        ),
        *(_open_sections if experiment == "open" else _confined_sections)(data, drawn),
        Section("Calibration", "One log of random static poses for each twin.", warnings=warnings),
        Section("Every run", "Mean over the goals reached.", (_table(data["runs"], columns),)),
    )
    text = page(TITLES[experiment], first, sections, f"<h2>Film</h2>{film_html}", provenance)
    (folder / PAGES[experiment]).write_text(text, "utf-8")
    return data


def figures_of(experiment: str, folder: Path, settings: Settings, results: Results) -> dict[str, Any]:
    """Return all figures: goals, spreads, trainings or simulated errors, calibrations, every run."""
    table, trainings = trial_rows(results), training_rows(results)
    shared = {**settings.shared(), "twins": list(settings.twins), "seeds": list(settings.seeds)}
    calibrations = {}
    for twin in settings.twins:
        report = json.loads((folder / f"twin{twin}" / CALIBRATION / "report.json").read_text("utf-8"))
        calibrations[f"twin {twin}"] = {title: part["warnings"] for title, part in report["parts"].items()}
    more = {"simulated": simulated_rows(folder, settings, table)} if experiment == "open" else {}
    return {
        "arm": "twin",
        "settings": shared,
        "goals": [check._asdict() for check in check_goals(experiment, table, trainings)],
        "spreads": spreads(table),
        "calibrations": calibrations,
        "runs": table,
        "trainings": trainings,
        **more,
    }


def draw(
    experiment: str, settings: Settings, results: Results, table: Sequence[Row]
) -> dict[str, tuple[str, Figure]]:
    """Return name -> caption and drawing."""
    outcomes, first = results.outcomes, filmed(experiment, settings)
    one, every = f"twin {first.twin}, seed {first.seed}", "over twins and seeds"
    if experiment == "open":
        chambers = ArmSpec.default().chambers
        limits_kpa = (chambers.pressure_min_kpa, chambers.pressure_max_kpa)
        traces = {
            f"pressures-{load_g}g": (
                f"Springs and pressures with {load_g} g, {one}",
                plots.trace_figure(outcomes[first._replace(load_g=load_g)], limits_kpa),
            )
            for load_g in settings.loads_g[-2:]
        }
        circle = plots.circle_figure(outcomes, plots.OPEN_STYLES)
        return {
            "circle": ("Circle from above, first seed, no load", circle),
            "loads": ("Unknown loads, with S2R: every run and the mean", plots.loads_figure(table)),
            **traces,
        }
    shown = [first, first._replace(objects="exchanged"), Trial("narrow", *first[1:])]
    circle = plots.circle_figure(outcomes, plots.CIRCLE_STYLES)
    return {
        "positions": (f"Finger tips from the front, {one}", plots.positions_figure(outcomes, shown)),
        "success": (f"Success over training, {every}", plots.success_figure(results)),
        "losses": (
            f"Losses with and without gradient penalty, twin {first.twin}",
            plots.losses_figure(results),
        ),
        "circle": ("Circle with and without demonstrations, first seed", circle),
    }


def _save_picture(path: Path, figure: Figure) -> None:
    """Write a drawing as PNG with few colours, which halves its size."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    Image.open(buffer).convert("RGB").quantize(N_COLOURS, Image.Quantize.MAXCOVERAGE).save(
        path, format="PNG", optimize=True
    )


def _open_sections(data: Row, drawn: Drawn) -> tuple[Section, ...]:
    circle, *loads = drawn.values()
    unloaded = [item for item in data["spreads"] if not item["load_g"]]
    with_s2r = [item for item in data["spreads"] if item["kind"] == "with"]
    return (
        Section(
            "Circle",
            "Mean ± standard deviation over twins and training seeds; errors by motion capture at rest, "
            "averaged over half a second. Without S2R, only the springs are calibrated. Gradient descent has "
            "no training seed and runs once for each twin.",
            (_spreads_table("open", unloaded),),
            figures=(circle,),
        ),
        Section(
            "Unknown loads",
            "The policy with S2R, which does not know the load. Solid: springs as read and pressures as "
            "measured; shaded: points at which a chamber is saturated.",
            (_spreads_table("open", with_s2r),),
            figures=tuple(loads),
        ),
        Section(
            "Simulated against twin",
            f"Mean error on the circle; the paper's, without S2R: {PAPER_SIMULATED_MM:g} mm in simulation.",
            (_table(data["simulated"], ("kind", "twin", "seed", "simulated_mm", "on_twin_mm")),),
        ),
    )


def _confined_sections(data: Row, drawn: Drawn) -> tuple[Section, ...]:
    def table(*kinds: str) -> tuple[Table, ...]:
        return (_spreads_table("confined", [item for item in data["spreads"] if item["kind"] in kinds]),)

    return (
        Section(
            "300 mm pipe",
            "Mean ± standard deviation over twins and training seeds, with one policy for both tasks; errors "
            "by motion capture at rest, averaged over half a second. Squares: where an object is picked or "
            "placed.",
            table("pipe", "hand-made"),
            figures=(drawn["positions"],),
        ),
        Section(
            "250 mm pipe",
            "The policy sees only the poses of the demonstrations in this pipe. Its reward is the "
            "environment's own plus the one learned in the 300 mm pipe, unchanged.",
            table("narrow"),
        ),
        Section(
            "Learned against hand-made reward",
            "Learned: a discriminator's reward alone; a quarter of the critics' batches are the expert's "
            "actions. Hand-made: the environment's reward at the same goals, with hindsight and without "
            "demonstrated actions. Success: pose reached, no chamber saturated, the body inside the pipe. "
            f"Dotted: {100 * SUCCESS:g} %. Bands: standard deviation over the runs.",
            (_table(data["trainings"], tuple(data["trainings"][0])),),
            figures=(drawn["success"], drawn["losses"]),
        ),
        Section(
            "Circle",
            "The policy without demonstrations continues to learn with 16 demonstrated points, 8 of them "
            "first, from the environment's reward and the learned one; then it follows the whole circle. "
            '"With S2R" is the policy without demonstrations.',
            table("circle", "with"),
            figures=(drawn["circle"],),
        ),
    )


def _spreads_table(experiment: str, items: Sequence[Row]) -> Table:
    """Return a row for each kind and variant, followed by the paper's numbers where it has any."""
    columns = ("kind", "variant", "runs", *COLUMNS[experiment])
    columns += ("all_done_runs",) if experiment == "confined" else ()
    rows = []
    for item in items:
        rows.append(item)
        if item["paper"]:
            rows.append({**dict.fromkeys(columns), "kind": "the paper's arm", **item["paper"]})
    return _table(rows, columns)


def _table(rows: Sequence[Row], columns: Sequence[str]) -> Table:
    """Return a table of the columns of rows."""
    head = tuple({**FIGURES, **HEADINGS}.get(name, name.replace("_", " ")) for name in columns)
    return Table(head, tuple(tuple(_cell(row[name]) for name in columns) for row in rows))


def _cell(value: Any) -> Any:
    """Return a spread as mean and deviation, the name of a kind as its title, None as a hyphen."""
    if isinstance(value, Mapping) and "mean" in value:
        return f"{value['mean']:.2f} ± {value['std']:.2f}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {n}" for name, n in value.items()) or "-"
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return KINDS[value].title if value in KINDS else "-" if value is None else value
