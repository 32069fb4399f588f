"""Report of an experiment: JSON, a picture, a film, and a table to print."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image

from benchmarks.paper.engine import Settings
from benchmarks.paper.kinds import KINDS
from benchmarks.paper.plots import circle_figure
from benchmarks.paper.scene import CALIBRATION
from benchmarks.paper.summary import Results, Row, spreads, training_rows, trial_rows
from benchmarks.paper.targets import check_targets
from benchmarks.paper.trials import FILMS
from mjx_softarm._support.provenance import provenance, write_json

DPI, N_COLOURS = 110, 64
PREFIXES = {"open": "paper", "confined": "paper-confined", "rod": "paper-rod"}  # of files beside the JSON
COLUMNS = {  # figures in the printed table
    "open": (
        *("translation_mm", "rmse_mm", "max_mm", "yaw_deg", "pitch_deg", "roll_deg"),
        *("saturated_points", "load_off_g"),
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
    """Write JSON file, picture and film of an experiment to the folder `pictures`; return the figures."""
    # The JSON file.
    data = figures_of(experiment, folder, settings, results)
    pictures.mkdir(parents=True, exist_ok=True)
    finite = json.loads(json.dumps(data), parse_constant=lambda _: None)  # JSON has no NaN
    write_json(pictures / json_name(experiment, settings), {"figures": finite, **provenance("benchmarks")})
    # The picture and the film.
    prefix, film = PREFIXES[_label(experiment, settings)], FILMS[experiment]
    if experiment == "open":
        _save_picture(pictures / f"{prefix}-circle.png", circle_figure(results.outcomes, settings.arm))
    if (folder / film).exists():
        shutil.copyfile(folder / film, pictures / f"{prefix}-{film}")
    return data


def figures_of(experiment: str, folder: Path, settings: Settings, results: Results) -> dict[str, Any]:
    """Return all figures: targets, spreads, warnings of calibrations, every run and every training."""
    table, trainings = trial_rows(results), training_rows(results)
    calibrations = {}
    for twin in settings.twins:
        report = json.loads((folder / f"twin{twin}" / CALIBRATION / "report.json").read_text("utf-8"))
        calibrations[f"twin {twin}"] = {title: part["warnings"] for title, part in report["parts"].items()}
    return {
        "arm": settings.arm,
        "settings": settings.as_json(),
        "targets": check_targets(experiment, table, trainings),
        "spreads": spreads(table),
        "calibrations": calibrations,
        "runs": table,
        "trainings": trainings,
    }


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
