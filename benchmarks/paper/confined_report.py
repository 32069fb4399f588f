"""What the experiments in confined spaces gave: JSON, pictures, one HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.paper.confined_film import FILM_FILE
from benchmarks.paper.confined_plots import (
    circle_figure,
    errors_figure,
    force_figure,
    losses_figure,
    positions_figure,
    success_figure,
)
from benchmarks.paper.confined_stages import KINDS, Results, Trial
from benchmarks.paper.confined_summary import (
    AVERAGED,
    SUCCESS,
    check_goals,
    circle_rows,
    rows,
    summarise,
    training_rows,
)
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
from benchmarks.paper.stages import Settings
from benchmarks.paper.summary import PAPER as PAPER_OPEN
from benchmarks.paper.summary import Check, spread
from calib.report.page import Section, Table, page

JSON_FILE, HTML_FILE = "paper-confined.json", "confined.html"
HEADINGS = {
    "x_mm": "x [mm]",
    "y_mm": "y [mm]",
    "z_mm": "z [mm]",
    "translation_mm": "translation [mm]",
    "max_mm": "largest [mm]",
    "saturated_positions": "positions with a saturated chamber",
    "done": "operations done",
    "calm_percent": "time without wall force [%]",
    "wall_max_n": "walls, largest [N]",
    "container_max_n": "containers, largest [N]",
}


def write_results(
    folder: Path,
    pictures: Path,
    settings: Settings,
    results: Results,
    no_film: str,
    provenance: dict[str, Any],
) -> dict[str, Any]:
    """Write the page and the JSON file; returns what is in the JSON file.

    Args:
        folder: of the benchmark, with the calibrations; the page goes there.
        pictures: where JSON file, pictures and film go.
        settings: of the benchmark.
        results: of all trainings and trials.
        no_film: why there is no film, or "".
        provenance: versions, machine and commit.
    """
    data = figures_of(folder, settings, results)
    drawn = draw(results)
    pictures.mkdir(parents=True, exist_ok=True)
    for name, (_, figure) in drawn.items():
        save_picture(pictures / f"paper-confined-{name}.png", figure)
    film = keep_film(folder / FILM_FILE, no_film, pictures / f"paper-confined-{FILM_FILE}")
    write_figures(pictures / JSON_FILE, data, provenance)
    (folder / HTML_FILE).write_text(to_html(data, drawn, film, no_film, provenance), "utf-8")
    return data


def figures_of(folder: Path, settings: Settings, results: Results) -> dict[str, Any]:
    """All figures: goals, spreads, trainings, calibrations, every run."""
    table, without, trainings = rows(results), circle_rows(results), training_rows(results)
    return {
        "arm": "twin",
        "settings": {**settings.fixed(), "twins": list(settings.twins), "seeds": list(settings.seeds)},
        "goals": [check._asdict() for check in check_goals(table, without, trainings)],
        "spreads": summarise(table),
        "circle_without_demonstrations": {
            "runs": len(without),
            "translation_mm": spread([row["translation_mm"] for row in without])._asdict(),
            "paper": {"translation_mm": PAPER_OPEN["with"]["translation_mm"]},
        },
        "trainings": trainings,
        "calibrations": {f"twin {twin}": calibration_of(folder, twin) for twin in settings.twins},
        "runs": table,
        "circles": without,
    }


def draw(results: Results) -> Drawn:
    """Name -> what is shown, and the drawing."""
    twin, seed = min((trial.twin, trial.seed) for trial in results.trials)
    shown = [
        Trial("pipe", twin, seed),
        Trial("pipe", twin, seed, "exchanged"),
        Trial("narrow", twin, seed),
    ]
    of, all_runs = f"twin {twin}, seed {seed}", "over twins and seeds"
    return {
        "positions": (f"Finger tips from the front, {of}", positions_figure(results, shown)),
        "errors": (f"Errors in the 300 mm pipe, {all_runs}", errors_figure(results, "pipe", "as shown")),
        "errors-narrow": (
            f"Errors in the 250 mm pipe, {all_runs}",
            errors_figure(results, "narrow", "as shown"),
        ),
        "force": (f"Contact forces, {of}", force_figure(results, shown)),
        "success": (
            f"Success over training, {all_runs}",
            success_figure(results, ("pipe", "hand-made")),
        ),
        "losses": (
            f"Losses with and without gradient penalty, twin {twin}",
            losses_figure(results, ("pipe", "no-penalty")),
        ),
        "circle": ("Circle with and without demonstrations, first seed", circle_figure(results)),
    }


def to_html(
    data: Mapping[str, Any],
    drawn: Drawn,
    film: Path | None,
    no_film: str,
    provenance: dict[str, Any],
) -> str:
    """The page; it needs no other file."""
    checks = [Check(**check) for check in data["goals"]]
    parts = (
        goals_part(checks),
        _pipe_part(data, drawn),
        _narrow_part(data, drawn),
        _training_part(data, drawn),
        _circle_part(data, drawn),
        calibration_part(data["calibrations"]),
        Section("Every run", "Mean over the positions arrived at.", (_runs_table(data["runs"]),)),
        Section(
            "Every training",
            "In the simulation of the calibrated arm.",
            (_trainings_table(data["trainings"]),),
        ),
    )
    film_html = film_part(film, no_film, "The twin in the pipe, cut open")
    title = "The paper's experiments in confined spaces"
    return page(title, first_of_page(checks), parts, film_html, provenance)


def _pipe_part(data: Mapping[str, Any], drawn: Drawn) -> Section:
    text = (
        "Mean ± standard deviation over twins and training seeds, with one policy for both tasks; errors by "
        "motion capture at rest, averaged over half a second. Squares and dotted lines: where a thing is "
        "picked or placed. Dashed in the forces: what counts as none."
    )
    names = ("positions", "errors", "force")
    chosen = [item for item in data["spreads"] if item["kind"] in ("pipe", "hand-made")]
    return Section("300 mm pipe", text, (_spreads_table(chosen),), figures=tuple(drawn[n] for n in names))


def _narrow_part(data: Mapping[str, Any], drawn: Drawn) -> Section:
    text = (
        "Of the demonstrations in this pipe, the positions alone are seen. The reward is the environment's "
        "own, and, as it is, the one learned in the 300 mm pipe."
    )
    chosen = [item for item in data["spreads"] if item["kind"] == "narrow"]
    return Section("250 mm pipe", text, (_spreads_table(chosen),), figures=(drawn["errors-narrow"],))


def _training_part(data: Mapping[str, Any], drawn: Drawn) -> Section:
    text = (
        "Learned: a discriminator's reward alone, and a quarter of each batch of the critics the expert's "
        "answers. Hand-made: the environment's reward at the same goals, with hindsight; no demonstrated "
        "action is seen. Success: the pose reached, no chamber saturated, the body inside the pipe. Dotted: "
        f"{100 * SUCCESS:g} %. Bands: standard deviation over the runs."
    )
    return Section("Learned against hand-made reward", text, figures=(drawn["success"], drawn["losses"]))


def _circle_part(data: Mapping[str, Any], drawn: Drawn) -> Section:
    text = (
        "The policy without demonstrations learns on with 16 demonstrated points, 8 of them first, by the "
        "environment's reward and the learned one; followed at all points of the circle."
    )
    chosen = [item for item in data["spreads"] if item["kind"] == "circle"]
    without = data["circle_without_demonstrations"]
    body = [(KINDS[item["kind"]].title, item["runs"], item) for item in chosen]
    body.append(("without demonstrations", without["runs"], without))
    table = Table(
        ("", "runs", "twin: translation [mm]", "paper"),
        tuple(
            (name, n, _around(item["translation_mm"]), item["paper"].get("translation_mm", "-"))
            for name, n, item in body
        ),
    )
    return Section("Circle", text, (table,), figures=(drawn["circle"],))


def _around(of: Mapping[str, float]) -> str:
    return f"{of['mean']:.2f} ± {of['std']:.2f}"


def _spreads_table(spreads: Sequence[Mapping[str, Any]]) -> Table:
    """Figures down, kinds across: there are more figures."""
    head = [""]
    for item in spreads:
        head.append(f"twin: {KINDS[item['kind']].title}, {item['objects']}")
        if item["paper"]:
            head.append("paper")
    body = [_line(HEADINGS[name], spreads, name) for name in AVERAGED]
    for name, title in (("runs", "runs"), ("all_done_runs", "with all operations done")):
        row = [title]
        for item in spreads:
            row += [item[name], "-"] if item["paper"] else [item[name]]
        body.append(tuple(row))
    return Table(tuple(head), tuple(body))


def _line(title: str, spreads: Sequence[Mapping[str, Any]], name: str) -> tuple[Any, ...]:
    row = [title]
    for item in spreads:
        row.append(_around(item[name]))
        if item["paper"]:
            row.append(item["paper"].get(name, "-"))
    return tuple(row)


def _runs_table(table: Sequence[Mapping[str, Any]]) -> Table:
    names = ("reached", *AVERAGED, "seconds")
    head = ("", "objects", "twin", "seed", *(HEADINGS.get(name, name) for name in names), "told by the loop")
    body = []
    for row in table:
        told = ", ".join(f"{name}: {n}" for name, n in row["events"].items()) or "-"
        start = (KINDS[row["kind"]].title, row["objects"], row["twin"], row["seed"])
        body.append((*start, *(row[name] for name in names), told))
    return Table(head, tuple(body))


def _trainings_table(trainings: Sequence[Mapping[str, Any]]) -> Table:
    percent = f"{100 * SUCCESS:g} %"
    head = (
        "",
        "twin",
        "seed",
        "steps",
        f"to {percent} success",
        "success",
        "first stage's, as it ended",
        "now",
    )
    body = []
    for row in trainings:
        steps = "never" if row["steps_to_success"] is None else row["steps_to_success"]
        start = (KINDS[row["kind"]].title, row["twin"], row["seed"], row["env_steps"])
        body.append((*start, steps, row["final_success"], *(row["stages_first_success"] or ("-", "-"))))
    return Table(head, tuple(body))
