"""What the pages of the paper's experiments share: goals, verdict, pictures, film, JSON."""

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

from benchmarks.paper.stages import CALIBRATION
from benchmarks.paper.summary import Check
from calib.report.page import Section, Table
from mjx_softarm._support.provenance import write_json

DPI, N_COLOURS = 110, 64

Drawn = Mapping[str, tuple[str, Figure]]  # name -> what is shown, and the drawing


def write_figures(path: Path, data: Mapping[str, Any], provenance: Mapping[str, Any]) -> None:
    """Write figures with what they depend on as JSON, which has no NaN: that becomes null."""
    figures = json.loads(json.dumps(data), parse_constant=lambda _: None)
    write_json(path, {"figures": figures, **provenance})


def save_picture(path: Path, figure: Figure) -> None:
    """Write a drawing as PNG with few colours, which halves it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    Image.open(buffer).convert("RGB").quantize(N_COLOURS).save(path, format="PNG", optimize=True)


def keep_film(film: Path, no_film: str, path: Path) -> Path | None:
    """Copy a film, unless it could not be made; returns where it was, None without one."""
    if no_film or not film.exists():
        return None
    shutil.copyfile(film, path)
    return film


def calibration_of(folder: Path, twin: int) -> dict[str, list[str]]:
    """Each step of a twin's calibration with its warnings."""
    report = json.loads((folder / f"twin{twin}" / CALIBRATION / "report.json").read_text("utf-8"))
    return {title: part["warnings"] for title, part in report["parts"].items()}


def first_of_page(checks: Sequence[Check]) -> str:
    """What stands above all parts, as HTML."""
    n_missed = sum(not check.met for check in checks)
    verdict = (
        '<p class="good">Every goal is met.</p>'
        if n_missed == 0
        else f'<p class="bad">{n_missed} of {len(checks)} goals are not met.</p>'
    )
    return f"<p>All measured on the simulated arm called twin; no number is of a real arm.</p>{verdict}"


def goals_part(checks: Sequence[Check]) -> Section:
    """The goals, those that are missed above the others."""
    table = Table(
        ("goal", "twin", ""), tuple((c.text, c.value, "met" if c.met else "NOT MET") for c in checks)
    )
    missed = tuple(f"not met: {check.text}: {check.value}" for check in checks if not check.met)
    return Section("Goals", "Set before anything was measured.", (table,), missed)


def calibration_part(calibrations: Mapping[str, Mapping[str, Sequence[str]]]) -> Section:
    """Warnings of the twins' calibrations, each from `calibration_of`."""
    warnings = tuple(
        f"{twin}: {title}: {warning}"
        for twin, steps in calibrations.items()
        for title, found in steps.items()
        for warning in found
    )
    return Section("Calibration", "One log of random poses at rest for each twin.", warnings=warnings)


def film_part(film: Path | None, no_film: str, shown: str) -> str:
    """The film with what it shows, or why there is none, as HTML."""
    if film is None:
        return f"<h2>Film</h2><p>None: {html.escape(no_film)}</p>"
    data = base64.b64encode(film.read_bytes()).decode()
    return f'<h2>Film</h2><p><img alt="{html.escape(shown)}" src="data:image/gif;base64,{data}"></p>'
