"""The panel beside the picture: state of the arm, bars of pressures and springs, traces."""

from __future__ import annotations

import html
from collections import deque
from collections.abc import Sequence

import numpy as np
import viser
from viser import uplot

from mjx_softarm.spec import ArmSpec
from mjx_softarm.view.look import Look
from mjx_softarm.view.stage import GOAL, SATURATED, SEEN, section_colours

TRACE_S, TRACE_POINTS = 20.0, 200
_WIDTH, _TOP, _FOOT = 300, 6, 66  # width, top and foot of the bars [px]
BLUE, MUTED = "#2463a8", "#868e96"


class Panel:
    """Text, bars and traces of one arm."""

    def __init__(self, gui: viser.GuiApi, spec: ArmSpec):
        self._spec = spec
        self._text = gui.add_html("", order=0.2)  # below the buttons, above all else
        with gui.add_folder("Chambers and springs"):
            self._bars = gui.add_html("")
        with gui.add_folder("Traces"):
            lines = ("estimated", css(GOAL)), ("measured", css(SEEN))
            self._errors = plot(gui, "tip error [mm], violet: measured", lines)
            colours = section_colours(spec, spec.n_chambers)
            lines = [(f"chamber {k}", css(colour)) for k, colour in enumerate(colours)]
            self._pressures = plot(gui, "pressures [kPa]", lines)
        self._trace: deque[tuple] = deque(maxlen=TRACE_POINTS)

    def show_bars(self, look: Look) -> None:
        """Draw the bars of a moment."""
        self._bars.content = bars(look, self._spec)

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
            offs = (("estimated", look.error_mm(look.estimate)), ("measured", look.error_mm(look.seen)))
            known = [(name, off_mm) for name, off_mm in offs if np.isfinite(off_mm)]
            rows += "".join(
                f"<br>tip <b>{off_mm:.1f} mm</b> from the goal, as {name}" for name, off_mm in known
            )
            if np.isfinite(look.load_kg):
                rows += f"<br>payload <b>{1e3 * look.load_kg:.0f} g</b>, estimated from springs and pressures"
        said = "".join(f"<div>{html.escape(line)}</div>" for line in lines)
        self._text.content = (
            "<div style='padding:0.5em 0.8em 0.2em;font-size:12px;line-height:1.5;overflow-wrap:anywhere'>"
            f"<div style='background:{colour};color:white;border-radius:6px;padding:0.4em 0.8em;"
            f"font-weight:600;font-size:13px'>{html.escape(title)}</div>"
            f"<div style='margin-top:0.4em'>{rows}</div>"
            f"<div style='margin-top:0.3em;font-size:11px;color:#495057'>{said}</div></div>"
        )


def bars(look: Look, spec: ArmSpec) -> str:
    """Return bars of pressures between their limits, and of springs beside their references, as HTML."""
    limits_kpa = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    limits_m = spec.at_springs(spec.springs.length_min_m), spec.at_springs(spec.springs.length_max_m)
    zero = np.zeros(spec.n_chambers)
    beside = look.saturated[:: spec.n_chambers // spec.n_springs]  # chambers that have a spring beside them
    # Words below the bars, and a note about saturated chambers.
    kpa = [f"{p:.0f}" for p in look.pressure_kpa]
    off = [f"{1e3 * (a - b):+.1f}" for a, b in zip(look.spring_m, look.reference_m, strict=True)]
    names = ", ".join(map(str, np.flatnonzero(look.saturated)))
    note = f"saturated: chamber {names}" if names else "no chamber saturated"
    line = "<div style='padding:0.2em 1em;font-size:11px;color:{}'>{}</div>"
    colours = [section_colours(spec, n) for n in (spec.n_chambers, spec.n_springs)]
    return (
        line.format(MUTED, "pressures, {:g} to {:g} kPa".format(*limits_kpa))
        + _bars((zero, look.pressure_kpa, zero), limits_kpa, look.saturated, kpa, colours[0])
        + line.format(MUTED, "springs beside their references, off by mm")
        + _bars((limits_m[0], look.spring_m, look.reference_m), limits_m, beside, off, colours[1])
        + line.format(css(SATURATED) if names else MUTED, note)
    )


def _bars(
    levels: tuple[np.ndarray, np.ndarray, np.ndarray],
    limits: tuple[np.ndarray, np.ndarray] | tuple[float, float],
    warned: np.ndarray,
    words: Sequence[str],
    colours: Sequence[tuple[int, int, int]],
) -> str:
    """Return n bars from feet to values, with marks across them, as SVG; a NaN has no bar.

    `levels` are feet, values and marks, between `limits` at the bottom and the top of the frames. Frames of
    `warned` bars have another colour. `words` stand below the bars.
    """
    wide, parts = _WIDTH / len(words), []
    gap = min(10.0, wide / 3)  # between two frames
    inset = gap / 5  # between a frame and its bar

    # For each bar its frame, bar, mark and word.
    shares = [(np.clip(level, *limits) - limits[0]) / (limits[1] - limits[0]) for level in levels]
    for k, heights in enumerate(_FOOT - np.stack(shares, axis=-1) * (_FOOT - _TOP)):
        foot, value, mark = heights
        x, edge = wide * k + gap / 2, css(SATURATED) if warned[k] else "#dee2e6"
        size = f"width='{wide - gap:.1f}' height='{_FOOT - _TOP}' rx='2' stroke-width='{1 + warned[k]}'"
        parts.append(f"<rect x='{x:.1f}' y='{_TOP}' {size} fill='#f8f9fa' stroke='{edge}'/>")
        if np.isfinite(value):
            top, low = sorted((value, foot))
            size = f"width='{wide - gap - 2 * inset:.1f}' height='{max(low - top, 1.0):.1f}'"
            parts.append(f"<rect x='{x + inset:.1f}' y='{top:.1f}' {size} fill='{css(colours[k])}'/>")
        if np.isfinite(mark):
            line = f"<line x1='{x - 1:.1f}' x2='{x + wide - gap + 1:.1f}' y1='{mark:.1f}' y2='{mark:.1f}'"
            parts.append(f"{line} stroke='#343a40' stroke-width='1.5'/>")
        at = f"x='{wide * (k + 0.5):.1f}' y='{_FOOT + 11}' font-size='{min(9.0, wide / 2):.3g}'"
        parts.append(f"<text {at} text-anchor='middle' fill='{MUTED}'>{words[k].replace('nan', '?')}</text>")
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
