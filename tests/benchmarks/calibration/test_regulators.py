"""Regulators fitted to one day of a real arm's log, asked for the pressures of another day."""

from pathlib import Path

import pytest

from benchmarks.calibration import regulators

DATA = Path(__file__).parents[3].parent / "shared/data"


@pytest.mark.skipif(not DATA.is_dir(), reason="the real logs are not beside the checkout")
def test_real_pressures_of_another_day():
    """The log of apr4 moves two of six chambers, once each."""
    found = regulators.measure(DATA)
    for fitted, asked, most_psi in (("apr5", "apr4", 0.5), ("apr4", "apr5", 0.65)):
        rms = found[f"fitted to {fitted}"]["RMS [psi]"]
        assert rms[f"of {asked}"]["all"] < most_psi
        assert rms[f"of {asked}"]["all"] < 0.4 * rms[f"of {asked}, the command taken for the pressure"]["all"]
        assert rms[f"of {fitted}, the day of the fit"]["all"] < 0.4
