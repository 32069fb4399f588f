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
from benchmarks.paper.goals import Check, check_goals
from benchmarks.paper.jobs import CALIBRATION
from benchmarks.paper.kinds import KINDS, Trial
from benchmarks.paper.summary import (
    HEADINGS,
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
COLUMNS = {  # figures in the tables, keys of HEADINGS
    "open": (
        *("translation_mm", "rmse_mm", "max_mm", "yaw_deg", "pitch_deg", "roll_deg", "believed_mm"),
        *("saturated_points", "saturated_chambers_max", "saturation_events"),
    ),
    "confined": (
        *("x_mm", "y_mm", "z_mm", "translation_mm", "max_mm", "saturated_points", "done"),
        *("calm_percent", "wall_max_n", "container_max_n"),
    ),
}

Drawn = Mapping[str, tuple[str, Figure]]  # name -> caption, and the drawing


def write_report(
    experiment: str,
    folder: Path,
    pictures: Path,
    settings: Settings,
    results: Results,
    no_film: str,
    provenance: dict[str, Any],
) -> dict[str, Any]:
    """Write page, JSON, pictures and film; returns what is in the JSON file.

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
    prefix, film = PREFIXES[experiment], folder / FILMS[experiment]
    for name, (_, figure) in drawn.items():
        _save_picture(pictures / f"{prefix}-{name}.png", figure)
    if film.exists():
        shutil.copyfile(film, pictures / f"{prefix}-{film.name}")
    finite = json.loads(json.dumps(data), parse_constant=lambda _: None)  # JSON has no NaN
    write_json(pictures / f"paper-{experiment}.json", {"figures": finite, **provenance})
    checks = [Check(**check) for check in data["goals"]]
    n_missed = sum(not check.met for check in checks)
    verdict = "Every goal is met." if not n_missed else f"{n_missed} of {len(checks)} goals are not met."
    first = (
        "<p>All measured on simulated arms called twins; no number is of a real arm.</p>"
        f'<p class="{"bad" if n_missed else "good"}">{verdict}</p>'
    )
    sections = (
        _goals_section(checks),
        *(_open_sections if experiment == "open" else _confined_sections)(data, drawn),
        _calibration_section(data["calibrations"]),
        Section("Every run", "Mean over the goals reached.", (_runs_table(experiment, data["runs"]),)),
    )
    text = page(TITLES[experiment], first, sections, _film_html(film, no_film), provenance)
    (folder / PAGES[experiment]).write_text(text, "utf-8")
    return data


def figures_of(experiment: str, folder: Path, settings: Settings, results: Results) -> dict[str, Any]:
    """Return all figures: goals, spreads, trainings or simulated errors, calibrations, every run."""
    table, trainings = trial_rows(results), training_rows(results)
    shared = {**settings.shared(), "twins": list(settings.twins), "seeds": list(settings.seeds)}
    data = {
        "arm": "twin",
        "settings": shared,
        "goals": [check._asdict() for check in check_goals(experiment, table, trainings)],
        "spreads": spreads(table),
        "calibrations": {f"twin {twin}": _calibration_warnings(folder, twin) for twin in settings.twins},
        "runs": table,
    }
    if experiment == "open":
        return data | {"simulated": simulated_rows(folder, settings, table)}
    return data | {"trainings": trainings}


def _calibration_warnings(folder: Path, twin: int) -> dict[str, list[str]]:
    report = json.loads((folder / f"twin{twin}" / CALIBRATION / "report.json").read_text("utf-8"))
    return {title: section["warnings"] for title, section in report["parts"].items()}


def draw(
    experiment: str, settings: Settings, results: Results, table: Sequence[Mapping[str, Any]]
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
            "error": (f"Error at each point: mean and range {every}, no load", plots.error_figure(outcomes)),
            "loads": ("Unknown loads, with S2R: every run and the mean", plots.loads_figure(table)),
            **traces,
        }
    shown = [first, first._replace(objects="exchanged"), Trial("narrow", *first[1:])]
    circle = plots.circle_figure(outcomes, plots.CIRCLE_STYLES)
    return {
        "positions": (f"Finger tips from the front, {one}", plots.positions_figure(outcomes, shown)),
        "errors": (f"Errors in the 300 mm pipe, {every}", plots.axis_errors_figure(outcomes, "pipe")),
        "force": (f"Contact forces, {one}", plots.force_figure(outcomes, shown)),
        "errors-narrow": (
            f"Errors in the 250 mm pipe, {every}",
            plots.axis_errors_figure(outcomes, "narrow"),
        ),
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


def _film_html(film: Path, no_film: str) -> str:
    if not film.exists():
        return f"<h2>Film</h2><p>None: {html.escape(no_film)}</p>"
    data = base64.b64encode(film.read_bytes()).decode()
    return f'<h2>Film</h2><p><img alt="The twin, filmed" src="data:image/gif;base64,{data}"></p>'


def _goals_section(checks: Sequence[Check]) -> Section:
    rows = tuple((check.text, check.value, "met" if check.met else "NOT MET") for check in checks)
    missed = tuple(f"not met: {check.text}: {check.value}" for check in checks if not check.met)
    return Section("Goals", "Set before anything was measured.", (Table(("goal", "twin", ""), rows),), missed)


def _calibration_section(calibrations: Mapping[str, Mapping[str, Sequence[str]]]) -> Section:
    warnings = tuple(
        f"{twin}: {title}: {warning}"
        for twin, steps in calibrations.items()
        for title, found in steps.items()
        for warning in found
    )
    return Section("Calibration", "One log of random poses at rest for each twin.", warnings=warnings)


def _open_sections(data: Mapping[str, Any], drawn: Drawn) -> tuple[Section, ...]:
    unloaded = [item for item in data["spreads"] if not item["load_g"]]
    with_s2r = [item for item in data["spreads"] if item["kind"] == "with"]
    traces = tuple(item for name, item in drawn.items() if name.startswith("pressures"))
    simulated = tuple(
        (
            KINDS[row["kind"]].title,
            "all" if row["twin"] is None else row["twin"],
            row["seed"],
            row["simulated_mm"],
            row["on_twin_mm"]["mean"],
        )
        for row in data["simulated"]
    )
    return (
        Section(
            "Circle",
            "Mean ± standard deviation over twins and training seeds; errors by motion capture at rest, "
            "averaged over half a second. Without S2R, only the springs are calibrated. Gradient descent has "
            "no training seed and runs once for each twin.",
            (_spreads_table("open", unloaded),),
            figures=(drawn["circle"], drawn["error"]),
        ),
        Section(
            "Unknown loads",
            "The policy with S2R, which does not know the load. Solid: springs as read and pressures as "
            "measured; shaded: points at which a chamber is saturated.",
            (_spreads_table("open", with_s2r),),
            figures=(drawn["loads"], *traces),
        ),
        Section(
            "Simulated against twin",
            f"Mean error on the circle; the paper's, without S2R: {PAPER_SIMULATED_MM:g} mm in simulation.",
            (Table(("policy", "twin", "seed", "simulated [mm]", "on the twin [mm]"), simulated),),
        ),
    )


def _confined_sections(data: Mapping[str, Any], drawn: Drawn) -> tuple[Section, ...]:
    def table(*kinds: str) -> tuple[Table, ...]:
        return (_spreads_table("confined", [item for item in data["spreads"] if item["kind"] in kinds]),)

    return (
        Section(
            "300 mm pipe",
            "Mean ± standard deviation over twins and training seeds, with one policy for both tasks; errors "
            "by motion capture at rest, averaged over half a second. Squares and dotted lines: where an "
            "object is picked or placed. Dashed in the forces: what counts as none.",
            table("pipe", "hand-made"),
            figures=tuple(drawn[name] for name in ("positions", "errors", "force")),
        ),
        Section(
            "250 mm pipe",
            "The policy sees only the poses of the demonstrations in this pipe. Its reward is the "
            "environment's own plus the one learned in the 300 mm pipe, unchanged.",
            table("narrow"),
            figures=(drawn["errors-narrow"],),
        ),
        Section(
            "Learned against hand-made reward",
            "Learned: a discriminator's reward alone; a quarter of the critics' batches are the expert's "
            "actions. Hand-made: the environment's reward at the same goals, with hindsight and without "
            "demonstrated actions. Success: pose reached, no chamber saturated, the body inside the pipe. "
            f"Dotted: {100 * SUCCESS:g} %. Bands: standard deviation over the runs.",
            (_trainings_table(data["trainings"]),),
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


def _spreads_table(experiment: str, items: Sequence[Mapping[str, Any]]) -> Table:
    """Return figures down, kinds across, each beside the paper's numbers where it has any."""
    head, rows = [""], [["runs"], *([HEADINGS[name]] for name in COLUMNS[experiment])]
    if experiment == "confined":
        rows.append(["runs with all operations done"])
    for item in items:
        cells = [item["runs"]]
        cells += [f"{item[name]['mean']:.2f} ± {item[name]['std']:.2f}" for name in COLUMNS[experiment]]
        columns = [[*cells, item["all_done_runs"]]]
        head.append(f"twin: {KINDS[item['kind']].title}, {item['variant']}")
        if item["paper"]:
            head.append("paper")
            columns.append(["-", *(item["paper"].get(name, "-") for name in COLUMNS[experiment]), "-"])
        for column in columns:
            for row, cell in zip(rows, column, strict=False):
                row.append(cell)
    return Table(tuple(head), tuple(map(tuple, rows)))


def _runs_table(experiment: str, table: Sequence[Mapping[str, Any]]) -> Table:
    names = ("reached", *COLUMNS[experiment], "seconds")
    head = ("", "", "twin", "seed", *(HEADINGS.get(name, name) for name in names), "faults reported")
    body = []
    for row in table:
        faults = ", ".join(f"{name}: {n}" for name, n in row["events"].items()) or "-"
        start = (KINDS[row["kind"]].title, row["variant"], row["twin"], row["seed"])
        body.append((*start, *(row[name] for name in names), faults))
    return Table(head, tuple(body))


def _trainings_table(trainings: Sequence[Mapping[str, Any]]) -> Table:
    success = f"steps to {100 * SUCCESS:g} % success"
    head = ("", "twin", "seed", "steps", success, "success", "first stage's, as it ended", "at the end")
    body = []
    for row in trainings:
        steps = "never" if row["steps_to_success"] is None else row["steps_to_success"]
        start = (KINDS[row["kind"]].title, row["twin"], row["seed"], row["env_steps"])
        body.append((*start, steps, row["final_success"], *(row["stages_first_success"] or ("-", "-"))))
    return Table(head, tuple(body))
