"""Section of the report on what has changed since a calibration."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.changes import Changes
from calib.report.page import ReportTable, Section

CHANGES = "Changes"
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
    errors = (
        ("before", found.before.translation_mean_mm, found.before.rotation_mean_deg, found.before_kpa),
        ("with the changes", found.after.translation_mean_mm, found.after.rotation_mean_deg, found.after_kpa),
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
        _data(found),
        notes=(_sentence(found),),
    )


def _rows(name: str, *columns: np.ndarray) -> tuple[tuple[Any, ...], ...]:
    return tuple((f"{name} {k}", *map(float, row)) for k, row in enumerate(zip(*columns, strict=True)))


def _sentence(found: Changes) -> str:
    if not found.is_better:
        return "nothing has changed that these poses show: the calibration stays as it is"
    zero_mm = ", ".join(f"{x:+.1f}" for x in 1e3 * found.zero_m)
    mean, half = 100 * found.stiffness.mean(), 100 * found.mean_half_width
    return (
        f"zeros of the springs {zero_mm} mm; stiffness of the chambers {mean:+.0f} +- {half:.0f} %; tips at "
        f"held-out poses {found.before.translation_mean_mm:.1f} mm off before, "
        f"{found.after.translation_mean_mm:.1f} mm now"
    )


def _data(found: Changes) -> dict[str, Any]:
    """Return the numbers as JSON has them."""
    arrays = {"zero_m", "zero_half_width_m", "stiffness", "offset_kpa"}
    numbers = {"mean_half_width", "n", "before_kpa", "after_kpa", "is_better"}
    return (
        {name: np.asarray(getattr(found, name)).tolist() for name in sorted(arrays)}
        | {name: getattr(found, name) for name in sorted(numbers)}
        | {name: vars(getattr(found, name)) for name in ("before", "after")}
    )
