"""Sections of the report on later logs: what has changed since a calibration; what a known weight tells."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.changes import Changes
from calib.fit.payload import MOST_OFF, Weighed
from calib.report.page import ReportTable, Section, plain
from mjx_softarm.sensing.load import QUANTILE

CHANGES, PAYLOADS = "Changes", "Payloads"
ENOUGH = 2.0  # held-out error over that of the calibration, from which there is a warning; by hand


def changes_section(found: Changes, known_mm: float) -> Section:
    """Show what has changed, and whether that explains the later poses.

    Args:
        found: fitted changes.
        known_mm: mean error of the tip at held-out poses of the calibration, 0 if not known.
    """
    # Tables of the springs, the chambers and the errors
    springs = _rows("spring", 1e3 * found.zero_m, 1e3 * found.zero_half_width_m)
    chambers = _rows("chamber", 100 * found.stiffness, found.offset_kpa)
    errors = tuple(
        (what, tip.translation_mean_mm, tip.rotation_mean_deg, kpa)
        if tip.n
        else (what, "not measured", "not measured", kpa)
        for what, tip, kpa in (
            ("before", found.before, found.before_kpa),
            ("with the changes", found.after, found.after_kpa),
        )
    )
    tables = (
        ReportTable(("", "zero [mm]", "+-"), springs),
        ReportTable(("", "stiffness [%]", "pressure [kPa]"), chambers),
        ReportTable(("held-out poses", "tip [mm]", "turn [deg]", "pressures, RMS [kPa]"), errors),
    )

    # A sentence for the terminal, and a warning where more has changed
    warnings: tuple[str, ...] = ()
    after_mm = found.after.translation_mean_mm if found.is_better else found.before.translation_mean_mm
    if known_mm and after_mm > ENOUGH * known_mm:
        warnings = (
            f"{after_mm:.1f} mm remain at held-out poses, {known_mm:.1f} mm at the calibration: more has "
            "changed than zeros and stiffness, so record poses anew and calibrate",
        )
    return Section(
        CHANGES,
        f"{found.n} later poses of the unloaded arm against the calibrated simulation. Zeros are true "
        "lengths minus lengths read. A stiffness is told from an offset of the pressures to some per cent. "
        "Intervals are 95 %; contiguous blocks of poses are held out.",
        tables,
        warnings,
        plain(found, "spec") | {"is_better": found.is_better},
        notes=(_sentence(found),),
    )


def payloads_section(found: Weighed) -> Section:
    """Show how strongly the arm feels payloads, by poses with a known weight."""
    told = f"{found.n} poses with a known weight were told as {found.ratio:.3f} of it in the mean"
    if not found.is_plausible:
        expected = f"expected {1.0 - MOST_OFF:.1f} to {1.0 + MOST_OFF:.1f}"
        remedy = "check the weight and its unit, and whether the arm has changed since the calibration"
        warning = f"{told}, {expected}: {remedy}"
        return Section(PAYLOADS, f"{told}.", warnings=(warning,), data=found._asdict())
    percent = 100.0 * QUANTILE * found.factor_sd
    text = (
        f"{told}. So a payload changes the pressures by {found.factor:.3f} of the simulated change. Near "
        f"these poses this factor is known to {percent:.0f} % (95 %); other errors add to it."
    )
    off = 100.0 * (found.ratio - 1.0)
    note = f"payloads were told {abs(off):.1f} % too {'heavy' if off > 0.0 else 'light'}; this is corrected"
    return Section(PAYLOADS, text, data=found._asdict(), notes=(note,))


def _rows(name: str, *columns: np.ndarray) -> tuple[tuple[Any, ...], ...]:
    return tuple((f"{name} {k}", *map(float, row)) for k, row in enumerate(zip(*columns, strict=True)))


def _sentence(found: Changes) -> str:
    if not found.is_better:
        return "nothing has changed that these poses show: the calibration stays as it is"
    zero_mm = ", ".join(f"{x:+.1f}" for x in 1e3 * found.zero_m)
    mean, half = 100 * found.stiffness.mean(), 100 * found.mean_half_width
    what = f"zeros of the springs {zero_mm} mm; stiffness of the chambers {mean:+.0f} +- {half:.0f} %"
    if not found.before.n:  # no motion capture
        off = f"{found.before_kpa:.2f} kPa off before, {found.after_kpa:.2f} now"
        return f"{what}; pressures at held-out poses {off}"
    before_mm, after_mm = found.before.translation_mean_mm, found.after.translation_mean_mm
    return f"{what}; tips at held-out poses {before_mm:.1f} mm off before, {after_mm:.1f} mm now"
