"""Report of an experiment: JSON, pictures, films, and a table to print."""

from __future__ import annotations

import dataclasses
import io
import json
import shutil
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image

from benchmarks.harness.common import difference, target
from benchmarks.paper import plots
from benchmarks.paper.calibration_plots import calibration_figures, calibration_numbers
from benchmarks.paper.engine import Settings
from benchmarks.paper.jobs import CALIBRATION
from benchmarks.paper.kinds import KINDS
from benchmarks.paper.summary import Results, Row, simulated_rows, spreads, training_rows, trial_rows
from benchmarks.paper.targets import check_both_arms, check_targets
from benchmarks.paper.trials import FILMS, loads_film
from mjx_softarm._support.provenance import provenance, write_json

DPI, N_COLOURS = 110, 64
PREFIXES = {"open": "paper", "confined": "paper-confined", "rod": "paper-rod"}  # of files beside the JSON
COLUMNS = {  # figures in the printed table
    "open": (
        "translation_mm",
        "rmse_mm",
        "max_mm",
        "yaw_deg",
        "pitch_deg",
        "roll_deg",
        "saturated_points",
        "load_off_g",
    ),
    "confined": (
        *("x_mm", "y_mm", "z_mm", "translation_mm", "max_mm"),
        *("done", "calm_percent", "wall_max_n", "seconds"),
    ),
}


def json_name(experiment: str, settings: Settings) -> str:
    """Return the name of an experiment's JSON file."""
    return f"paper-{_label(experiment, settings)}.json"


def _label(experiment: str, settings: Settings) -> str:
    return experiment if settings.arm == "twin" else settings.arm


def write_report(
    experiment: str, folder: Path, pictures: Path, settings: Settings, results: Results
) -> dict[str, Any]:
    """Write JSON file, pictures and films of an experiment to the folder `pictures`; returns the figures."""
    data = figures_of(experiment, folder, settings, results)
    if experiment == "open":
        data["targets"] += _targets_of_both(pictures, settings, data["runs"])
    pictures.mkdir(parents=True, exist_ok=True)
    finite = json.loads(json.dumps(data), parse_constant=lambda _: None)  # JSON has no NaN
    write_json(pictures / json_name(experiment, settings), {"figures": finite, **provenance("benchmarks")})
    prefix, is_open = PREFIXES[_label(experiment, settings)], experiment == "open"
    drawn = draw(experiment, results, data["runs"], settings.arm)
    drawn |= calibration_figures(folder, settings) if is_open else {}
    for name, figure in drawn.items():
        _save_picture(pictures / f"{prefix}-{name}.png", figure)
    films = {FILMS[experiment]: FILMS[experiment]} | ({loads_film(settings): "loads.gif"} if is_open else {})
    for film, name in films.items():
        if (folder / film).exists():
            shutil.copyfile(folder / film, pictures / f"{prefix}-{name}")
    return data


def figures_of(experiment: str, folder: Path, settings: Settings, results: Results) -> dict[str, Any]:
    """Return all figures: targets, spreads, trainings or simulated errors, calibrations, every run."""
    table, trainings = trial_rows(results), training_rows(results)
    calibrations = {}
    for twin in settings.twins:
        report = json.loads((folder / f"twin{twin}" / CALIBRATION / "report.json").read_text("utf-8"))
        calibrations[f"twin {twin}"] = {title: part["warnings"] for title, part in report["parts"].items()}
    more = {}
    if experiment == "open":
        more["simulated"] = simulated_rows(folder, settings, table)
        more[f"{settings.arm} {settings.twins[0]} beside its simulation"] = calibration_numbers(
            folder, settings
        )
    return {
        "arm": settings.arm,
        "settings": settings.as_json(),
        "targets": check_targets(experiment, table, trainings),
        "spreads": spreads(table),
        "calibrations": calibrations,
        "runs": table,
        "trainings": trainings,
        **more,
    }


def _targets_of_both(pictures: Path, settings: Settings, table: list[Row]) -> list[dict[str, str]]:
    """Return the targets of twins and rods together; the other arm's runs are read from its file.

    Without a file, or with other settings than presets beside, they are not measured.
    """
    other = dataclasses.replace(settings, arm="rod" if settings.arm == "twin" else "twin")
    file = pictures / json_name("open", other)
    if not file.exists():
        return [target("twins and rods together", f"not measured: {file.name} is missing", None)]
    figures, expected = json.loads(file.read_text("utf-8"))["figures"], other.as_json()
    if differing := difference(figures["settings"] | {"beside": expected["beside"]}, expected):
        return [target("twins and rods together", f"not measured: {file.name}: {differing}", None)]
    return check_both_arms([table, figures["runs"]])


def draw(experiment: str, results: Results, table: list[dict[str, Any]], arm: str) -> dict[str, Figure]:
    """Return the drawings of an experiment by name."""
    if experiment == "open":
        return {"circle": plots.circle_figure(results.outcomes, arm), "loads": plots.loads_figure(table)}
    return {"success": plots.success_figure(results), "losses": plots.losses_figure(results)}


def _save_picture(path: Path, figure: Figure) -> None:
    """Write a drawing as PNG with few colours, which halves its size."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    Image.open(buffer).convert("RGB").quantize(N_COLOURS, Image.Quantize.MAXCOVERAGE).save(
        path, format="PNG", optimize=True
    )


def printed_rows(experiment: str, items: list[Row]) -> list[dict[str, Any]]:
    """Return spreads as mean ± deviation, each followed by the paper's numbers where it has any."""
    rows = []
    for item in items:
        cells = {name: f"{item[name]['mean']:.2f} ± {item[name]['std']:.2f}" for name in COLUMNS[experiment]}
        rows.append({"kind": KINDS[item["kind"]].title, "variant": item["variant"], "runs": item["runs"]})
        rows[-1] |= cells
        if item["paper"]:
            rows.append({"kind": "the paper's arm", **item["paper"]})
    return rows
