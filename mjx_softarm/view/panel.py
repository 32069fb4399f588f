"""The panel beside the picture: state of the arm, bars of pressures and springs, traces."""

from __future__ import annotations

import html
from collections import deque
from collections.abc import Sequence

import numpy as np
import viser
from viser import uplot

from mjx_softarm.view.look import Limits, Look
from mjx_softarm.view.stage import GOAL, SATURATED, SEEN, section_colour

TRACE_S, TRACE_POINTS = 20.0, 200
_WIDTH, _TOP, _FOOT = 300, 6, 66  # width, top and foot of the bars [px]
BLUE, MUTED = "#2463a8", "#868e96"


class Panel:
    """Text, bars and traces of one arm."""

    def __init__(self, gui: viser.GuiApi, limits: Limits, n: int):
        self._limits = limits
        self._text = gui.add_html("", order=0.2)  # below the buttons, above all else
        with gui.add_folder("Chambers and springs"):
            self._bars = gui.add_html("")
        with gui.add_folder("Traces"):
            lines = ("believed", css(GOAL)), ("seen", css(SEEN))
            self._errors = plot(gui, "tip error [mm], violet: seen", lines)
            colours = [(f"chamber {k}", css(section_colour(k))) for k in range(n)]
            self._pressures = plot(gui, "pressures [kPa]", colours)
        self._trace: deque[tuple] = deque(maxlen=TRACE_POINTS)

    def show_bars(self, look: Look) -> None:
        """Draw the bars of a moment."""
        self._bars.content = bars(look, self._limits)

    def show_traces(self, look: Look) -> None:
        """Add a moment to the traces; an earlier moment than the last clears them."""
        if self._trace and look.time_s < self._trace[-1][0]:
            self._trace.clear()
        errors = look.error_mm(look.estimate), look.error_mm(look.seen)
        self._trace.append((look.time_s, *errors, *look.pressure_kpa))
        time_s, *columns = np.array([row for row in self._trace if look.time_s - row[0] <= TRACE_S]).T
        self._errors.data, self._pressures.data = (time_s, *columns[:2]), (time_s, *columns[2:])

    def show_text(self, title: str, colour: str, look: Look | None, lines: Sequence[str] = ()) -> None:
        """Show a coloured title, the tip and its errors, and lines of text."""
        rows = ""
        if look is not None and np.isfinite(look.tip).all():
            rows = "tip at {:.1f}, {:.1f}, {:.1f} mm; {:.1f}, {:.1f}, {:.1f}°".format(*look.tip)
            offs = (("believed", look.error_mm(look.estimate)), ("seen", look.error_mm(look.seen)))
            known = [(name, off_mm) for name, off_mm in offs if np.isfinite(off_mm)]
            rows += "".join(
                f"<br>tip <b>{off_mm:.1f} mm</b> from the goal, as {name}" for name, off_mm in known
            )
        said = "".join(f"<div>{html.escape(line)}</div>" for line in lines)
        self._text.content = (
            "<div style='padding:0.5em 0.8em 0.2em;font-size:12px;line-height:1.5;overflow-wrap:anywhere'>"
            f"<div style='background:{colour};color:white;border-radius:6px;padding:0.4em 0.8em;"
            f"font-weight:600;font-size:13px'>{html.escape(title)}</div>"
            f"<div style='margin-top:0.4em'>{rows}</div>"
            f"<div style='margin-top:0.3em;font-size:11px;color:#495057'>{said}</div></div>"
        )


def bars(look: Look, limits: Limits) -> str:
    """Return bars of pressures between their limits, and of springs beside their references, as HTML."""
    low, high = float(limits.gains.pressure_min_kpa), float(limits.gains.pressure_max_kpa)
    saturated, zero = limits.saturated(look), np.zeros(len(look.spring_m))
    # Words below the bars, and a note about saturated chambers.
    kpa = [f"{p:.0f}" for p in look.pressure_kpa]
    off = [f"{1e3 * (a - b):+.1f}" for a, b in zip(look.spring_m, look.reference_m, strict=True)]
    names = ", ".join(map(str, np.flatnonzero(saturated)))
    note = f"saturated: chamber {names}" if names else "no chamber saturated"
    line = "<div style='padding:0.2em 1em;font-size:11px;color:{}'>{}</div>"
    return (
        line.format(MUTED, f"pressures, {low:g} to {high:g} kPa")
        + _bars(look.pressure_kpa, 0.0, zero, (low, high), saturated, kpa)
        + line.format(MUTED, "springs beside their references, off by mm")
        + _bars(look.spring_m, limits.spring_m[0], look.reference_m, limits.spring_m, saturated, off)
        + line.format(css(SATURATED) if names else MUTED, note)
    )


def _bars(values, foot, marks, limits: tuple[float, float], warned: np.ndarray, words: Sequence[str]) -> str:
    """Return bars from a foot to values, with marks across them, as SVG; a NaN has no bar."""
    wide, parts = _WIDTH / len(values), []

    def height(value: float) -> float:
        share = (np.clip(value, *limits) - limits[0]) / (limits[1] - limits[0])
        return _FOOT - share * (_FOOT - _TOP)

    # For each chamber its frame, bar, mark and word.
    for k, (value, mark) in enumerate(zip(values, marks, strict=True)):
        x, edge = wide * k + 5, css(SATURATED) if warned[k] else "#dee2e6"
        size = f"width='{wide - 10:.1f}' height='{_FOOT - _TOP}' rx='2' stroke-width='{1 + warned[k]}'"
        parts.append(f"<rect x='{x:.1f}' y='{_TOP}' {size} fill='#f8f9fa' stroke='{edge}'/>")
        if np.isfinite(value):
            top, low = sorted((height(value), height(foot)))
            size = f"width='{wide - 14:.1f}' height='{max(low - top, 1.0):.1f}'"
            parts.append(f"<rect x='{x + 2:.1f}' y='{top:.1f}' {size} fill='{css(section_colour(k))}'/>")
        if np.isfinite(mark):
            y, right = height(mark), x + wide - 9
            line = f"<line x1='{x - 1:.1f}' x2='{right:.1f}' y1='{y:.1f}' y2='{y:.1f}' stroke='#343a40'"
            parts.append(f"{line} stroke-width='1.5'/>")
        at = f"x='{x + wide / 2 - 5:.1f}' y='{_FOOT + 11}' font-size='9' text-anchor='middle'"
        parts.append(f"<text {at} fill='{MUTED}'>{words[k].replace('nan', '?')}</text>")
    box = f"viewBox='0 0 {_WIDTH} {_FOOT + 14}' style='width:100%;padding:0 0.6em'"
    return f"<svg {box}>{''.join(parts)}</svg>"


def css(colour: Sequence[int]) -> str:
    """Return a colour as CSS writes it."""
    return "#" + "".join(f"{part:02x}" for part in colour)


def plot(gui: viser.GuiApi, title: str, lines: Sequence[tuple[str, str]]) -> viser.GuiUplotHandle:
    """Add an empty plot of lines, each with a label and a colour, over one axis."""
    series = [uplot.Series(label="s"), *(uplot.Series(label=a, stroke=b, width=1.5) for a, b in lines)]
    scales = {"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)}
    nothing, legend = tuple(np.zeros(1) for _ in series), uplot.Legend(show=False)
    return gui.add_uplot(nothing, tuple(series), title=title, scales=scales, legend=legend, height=140)
