"""Report of a calibration: one HTML page with its pictures inside, and JSON."""

from __future__ import annotations

import base64
import dataclasses
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure


@dataclass(frozen=True)
class ReportTable:
    """Table of a report: a heading for each column, rows of text or numbers."""

    head: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]


@dataclass(frozen=True)
class Section:
    """Section of a report, one for each step of a calibration."""

    title: str
    text: str  # data and method of the fit, in a sentence or two
    tables: tuple[ReportTable, ...] = ()
    warnings: tuple[str, ...] = ()  # reasons not to trust the step, each with its remedy
    data: Any = None  # the same numbers for JSON
    figures: tuple[tuple[str, Figure], ...] = ()  # captions and drawings
    notes: tuple[str, ...] = ()  # facts that are worth a look, but no reason to distrust the step


def warning_lines(sections: Sequence[Section]) -> list[str]:
    """Return the warnings for the terminal: a line for each remedy, with all its reasons."""
    reasons: dict[str, list[str]] = {}
    for section in sections:
        for warning in section.warnings:
            reason, _, remedy = warning.partition("\n")[0].rpartition(": ")
            reasons.setdefault(remedy, []).append(f"{section.title}: {reason}")
    return [f"warning: {'; '.join(several)}: {remedy}" for remedy, several in reasons.items()]


def to_json(
    sections: Sequence[Section], findings: Sequence[str], provenance: dict[str, Any]
) -> dict[str, Any]:
    """Return the report as data."""
    return {
        "trustworthy": not any(section.warnings for section in sections),
        "parts": {
            section.title: {
                "figures": as_json(section.data),
                "warnings": list(section.warnings),
                "notes": list(section.notes),
            }
            for section in sections
        },
        "findings": list(findings),
        "provenance": provenance,
    }


def to_html(
    arm: str, sections: Sequence[Section], findings: Sequence[str], provenance: dict[str, Any]
) -> str:
    """Return the report of a calibration as one page that needs no other file."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"cell": _cell, "png": _png}
    values = {"title": f"Calibration of {arm}", "sections": sections, "findings": findings}
    return environment.get_template("calibration.html.j2").render(values, provenance=provenance)


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _png(figure: Figure) -> str:
    """Return a drawing as base64."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return base64.b64encode(buffer.getvalue()).decode()


def plain(fit: Any, *left_out: str) -> dict[str, Any]:
    """Return the fields of a fit, a named tuple or a dataclass, without its warnings."""
    fields = fit._asdict() if hasattr(fit, "_asdict") else vars(fit)
    return {name: value for name, value in fields.items() if name not in (*left_out, "warnings")}


def as_json(value: Any) -> Any:
    """Return a value as JSON has it: null for a number that is not known."""
    if hasattr(value, "_asdict") or dataclasses.is_dataclass(value):
        value = plain(value)
    if isinstance(value, Mapping):
        return {name: as_json(item) for name, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [as_json(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
