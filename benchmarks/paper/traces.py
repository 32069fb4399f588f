"""Traces of an arm on the circle: readings, spring lengths and pressures over time, with some payloads."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from benchmarks.accuracy.arms import accuracy_of
from benchmarks.harness.common import RESULTS
from benchmarks.paper.plots import RED
from calib.read.logs import read_log
from mjx_softarm.control import Gains
from mjx_softarm.logs.schema import Log
from mjx_softarm.policy.file import load_policy
from mjx_softarm.spec import ArmSpec
from train.runs.plots import DPI, dress

PICTURE = "traces.png"
SHADES = ("Blues", "Oranges", "Greens", "Purples")  # of the sections, in turn


def measure(
    policy: Path, arm: str = "twin:0", loads: tuple[int, ...] = (0, 500, 1000), points: int = 20
) -> dict[str, Any]:
    """How do readings, springs and pressures change on the circle, with and without a load, near a limit?

    The picture is `docs/results/traces.png`.

    Args:
        policy: file that `python -m train export` wrote
        arm: simulated arm, such as twin:0
        loads: payloads that the loop is not given, each on a lap of its own [g]
        points: goals of the circle
    """
    spec, logs, rows = load_policy(policy).spec, {}, []
    with tempfile.TemporaryDirectory() as folder:
        for load in loads:
            out, hung = Path(folder) / str(load), f":{load}g" if load else ""
            options = ("--points", points, "--payload", load)
            found = accuracy_of(policy, f"{arm}{hung}", out, *options)
            logs[load] = read_log(out / "log.npz", spec)[0]
            rows.append({"load [g]": load, "mean [mm]": found["translation_mm"], **shares(logs[load], spec)})
    traces_figure(logs, spec).savefig(RESULTS / PICTURE, dpi=DPI)
    return {"arm": arm, "laps": rows}


def shares(log: Log, spec: ArmSpec) -> dict[str, Any]:
    """Return the share of time with a chamber at a limit, which chambers, and the springs' mean deviation."""
    gains = Gains.from_spec(spec).measured()
    pressure_kpa = np.asarray(log.pressure_kpa)
    at_limit = (pressure_kpa < gains.pressure_min_kpa) | (pressure_kpa > gains.pressure_max_kpa)
    off_mm = 1e3 * np.abs(np.asarray(log.spring_m) - np.asarray(log.reference_m))
    return {
        "time with a chamber at a limit [%]": round(100 * float(at_limit.any(axis=1).mean()), 1),
        "chambers at a limit": " ".join(map(str, np.flatnonzero(at_limit.any(axis=0)))) or "none",
        "springs off their references, mean [mm]": round(float(np.nanmean(off_mm)), 2),
    }


def traces_figure(logs: Mapping[int, Log], spec: ArmSpec) -> Figure:
    """Draw readings, spring lengths with their references, and pressures: a column for each payload [g]."""
    # Panels, with shared axes along time and for each quantity
    titles = (
        f"{spec.sensor.reading_name} [{spec.sensor.unit}]",
        "spring lengths [mm]; dashed: references",
        "pressures [kPa]; red: limits",
    )
    figure = Figure(figsize=(4.2 * len(logs) + 0.6, 8.6), layout="constrained")
    panels = figure.subplots(len(titles), len(logs), squeeze=False, sharex="col", sharey="row")
    for column, (load, log) in zip(panels.T, logs.items(), strict=True):
        # Lines of all springs and chambers
        readings, spring_m, reference_m, pressure_kpa = map(
            np.asarray, (log.readings, log.spring_m, log.reference_m, log.pressure_kpa)
        )
        time_s, references = log.time_s - log.time_s[0], {"linestyle": "--", "linewidth": 0.6}
        lines = ((0, readings, {}), (1, 1e3 * spring_m, {}), (1, 1e3 * reference_m, references))
        for row, values, style in (*lines, (2, pressure_kpa, {})):
            for k, colour in enumerate(_colours(spec, values.shape[1])):
                column[row].plot(time_s, values[:, k], color=colour, **{"linewidth": 0.9, **style})
        # Titles, and the limits of pressure
        for panel, title in zip(column, titles, strict=True):
            dress(panel, f"{load} g: {title}" if panel is column[0] else title, "", "")
        for kpa in np.unique([spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa]):
            column[2].axhline(kpa, color=RED, linestyle="--", linewidth=1.0)
        column[2].set_xlabel("time [s]")
    return figure


def _colours(spec: ArmSpec, n: int) -> list[Any]:
    """Return a colour for each of n springs or chambers: a hue for each section, a shade for each within."""
    own = n // spec.structure.n_sections
    return [
        colormaps[SHADES[section % len(SHADES)]](0.45 + 0.5 * k / max(1, own - 1))
        for section in range(spec.structure.n_sections)
        for k in range(own)
    ]
