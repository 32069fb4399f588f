"""What a calibration found and whether to trust it: one HTML page with its pictures inside, and JSON."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; color: #222 }
h1 { font-size: 1.6rem }
h2 { font-size: 1.2rem; margin-top: 2.5rem; border-top: 1px solid #ddd; padding-top: 1rem }
table { border-collapse: collapse; margin: 1rem 0 }
thead { border-bottom: 1px solid #888 }
th, td { padding: .2rem .8rem; text-align: right }
th:first-child, td:first-child { text-align: left }
tbody tr:nth-child(odd) { background: #f6f6f6 }
img { max-width: 100% }
pre { overflow-x: auto; background: #f6f6f6; padding: .6rem }
.good, .bad { padding: .6rem 1rem; border-left: .4rem solid }
.good { border-color: #2a8; background: #effaf5 }
.bad { border-color: #c43; background: #fdf1ee }
"""


@dataclass(frozen=True)
class Table:
    """Columns with a heading each, rows of text or numbers."""

    head: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]


@dataclass(frozen=True)
class Section:
    """One step of a calibration.

    Attributes:
        title: of the section.
        text: what was fitted to what, in a sentence or two.
        tables: its figures.
        warnings: reasons not to trust it; none is good.
        data: the same figures for JSON.
        figures: drawings, each with what it shows.
    """

    title: str
    text: str
    tables: tuple[Table, ...] = ()
    warnings: tuple[str, ...] = ()
    data: Any = None
    figures: tuple[tuple[str, Figure], ...] = ()


def to_json(
    sections: Sequence[Section], findings: Sequence[str], provenance: dict[str, Any]
) -> dict[str, Any]:
    """The report as data."""
    return {
        "trustworthy": not any(section.warnings for section in sections),
        "parts": {
            section.title: {"figures": section.data, "warnings": list(section.warnings)}
            for section in sections
        },
        "findings": list(findings),
        "provenance": provenance,
    }


def to_html(
    arm: str, sections: Sequence[Section], findings: Sequence[str], provenance: dict[str, Any]
) -> str:
    """The report as one page that needs no other file."""
    logs = _list(findings) if findings else "<p>No fault was found in them.</p>"
    return page(f"Calibration of {arm}", _verdict(sections), sections, f"<h2>Logs</h2>{logs}", provenance)


def page(title: str, first: str, sections: Sequence[Section], last: str, provenance: dict[str, Any]) -> str:
    """A page of sections that needs no other file; `first` and `last` are HTML that stands around them."""
    body = [f"<h1>{html.escape(title)}</h1>", first]
    for section in sections:
        body += [
            f"<h2>{html.escape(section.title)}</h2>",
            f"<p>{html.escape(section.text)}</p>",
            _warnings(section),
        ]
        body += [_table(table) for table in section.tables]
        body += [_picture(text, figure) for text, figure in section.figures]
    body += [last, "<h2>How it was made</h2>", "<pre>", html.escape(_lines(provenance)), "</pre>"]
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{_STYLE}</style>'
    return f"<!doctype html><html lang=en><head>{head}</head><body>{''.join(body)}</body></html>\n"


def _verdict(sections: Sequence[Section]) -> str:
    doubtful = [section.title for section in sections if section.warnings]
    if not doubtful:
        return '<p class="good">Every fitted step met its own checks on data that it was not fitted to.</p>'
    return f'<p class="bad">Look at {html.escape(", ".join(doubtful))} before you trust this.</p>'


def _warnings(section: Section) -> str:
    return f'<div class="bad">{_list(section.warnings)}</div>' if section.warnings else ""


def _list(lines: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>"


def _table(table: Table) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in table.head)
    rows = ("".join(f"<td>{html.escape(_cell(value))}</td>" for value in row) for row in table.rows)
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _picture(title: str, figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<p><img alt="{html.escape(title)}" src="data:image/png;base64,{data}"></p>'


def _lines(provenance: dict[str, Any]) -> str:
    return "\n".join(f"{name}: {value}" for name, value in provenance.items())
