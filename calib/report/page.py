"""Report of a calibration: one HTML page with its pictures inside, and JSON. The pages are in `templates`."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure


@dataclass(frozen=True)
class Table:
    """Table of a report: a heading for each column, rows of text or numbers."""

    head: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]


@dataclass(frozen=True)
class Section:
    """Section of a report, one for each step of a calibration.

    Attributes:
        title: heading.
        text: data and method of the fit, in a sentence or two.
        tables: numbers.
        warnings: reasons not to trust the step, each with its remedy; none is good.
        notes: facts that are worth a look but no reason not to trust the step.
        data: the same numbers for JSON.
        figures: captions and drawings.
    """

    title: str
    text: str
    tables: tuple[Table, ...] = ()
    warnings: tuple[str, ...] = ()
    data: Any = None
    figures: tuple[tuple[str, Figure], ...] = ()
    notes: tuple[str, ...] = ()


def to_json(
    sections: Sequence[Section], findings: Sequence[str], provenance: dict[str, Any]
) -> dict[str, Any]:
    """Return the report as data."""
    return {
        "trustworthy": not any(section.warnings for section in sections),
        "parts": {
            section.title: {
                "figures": section.data,
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
    values = {"title": f"Calibration of {arm}", "sections": sections, "provenance": provenance}
    return _environment().get_template("calibration.html.j2").render(values, findings=findings)


def page(title: str, first: str, sections: Sequence[Section], last: str, provenance: dict[str, Any]) -> str:
    """Return any report as one page that needs no other file.

    Args:
        title: heading of the page.
        first: HTML above the sections.
        sections: what the page shows.
        last: HTML below the sections.
        provenance: versions, machine and commit.
    """
    values = {"title": title, "sections": sections, "provenance": provenance}
    return _environment().get_template("page.html.j2").render(values, first=Markup(first), last=Markup(last))


def _environment() -> Environment:
    templates = FileSystemLoader(Path(__file__).with_name("templates"))
    found = Environment(
        loader=templates,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    found.filters |= {"cell": _cell, "png": _png}
    return found


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _png(figure: Figure) -> str:
    """Return a drawing as base64."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return base64.b64encode(buffer.getvalue()).decode()
