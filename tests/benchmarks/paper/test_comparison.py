"""A twin beside its simulation: what is computed, what is saved, and which poses are drawn."""

import numpy as np
import pytest

from benchmarks.paper import comparison, jobs
from benchmarks.paper.calibration_plots import (
    calibration_figures,
    calibration_numbers,
    configurations_figure,
    spread_poses,
)
from benchmarks.paper.engine import load_arrays
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.spec import ARM_FILE
from tests.benchmarks.paper.made_up import SPEC, TINY, N, compared


def test_errors_are_distances_of_the_tips():
    found = compared(specified_mm=20.0, calibrated_mm=2.0, read_mm=9.0, corrected_mm=1.0).errors_mm
    expected = {"specified": 20.0, "calibrated": 2.0, "lengths": 9.0, "S2R": 1.0}
    assert {name: float(error.mean()) for name, error in found.items()} == pytest.approx(expected)


def test_chambers_follow_from_the_springs_beside_them():
    kpa = random_pressures(SPEC, 8, seed=1)
    shapes = comparison.simulate(SPEC, kpa)
    spring_m = comparison.settle_many(SPEC, kpa).spring_m
    assert shapes.plate_m.shape == (8, SPEC.n_links + 1, 3)
    assert np.abs(shapes.plate_m[:, -1] - shapes.tip_m).max() < 1e-5  # the specified tip is on the last plate
    assert np.abs(comparison.chambers_beside(SPEC, spring_m) - shapes.chamber_m).max() < 2e-4
    assert np.abs(spring_m - shapes.chamber_m).max() > 5e-3


def test_twin_is_compared_at_poses_that_its_calibration_has_not_seen(tmp_path, monkeypatch):
    here = tmp_path / "twin0"
    (here / jobs.CALIBRATION).mkdir(parents=True)
    SPEC.replace(mass={"arm_kg": 4.0}).to_toml(here / jobs.CALIBRATION / ARM_FILE)
    monkeypatch.setattr(jobs, "N_COMPARED", 3)
    jobs.compare_twin(tmp_path, TINY, 0)
    found = load_arrays(comparison.Comparison, here / jobs.COMPARISON_FILE)
    n = len(found.tip_m)
    assert 1 <= n <= 3
    assert found.chamber_pair_m.shape == (2, n, N) and found.plate_pair_m.shape == (2, n, SPEC.n_links + 1, 3)
    assert np.isnan(found.corrected_tip_m).all()  # without a network
    assert 1.0 < found.errors_mm["specified"].mean() < 100.0
    assert not np.allclose(*found.tip_pair_m)
    assert np.abs(found.read_tip_m - found.tip_pair_m[1]).max() < 0.1
    told = calibration_numbers(tmp_path, TINY)
    assert told["poses"] == n and told["tip_mean_mm"]["specified"] == found.errors_mm["specified"].mean()
    assert np.isfinite([*told["chamber_rms_mm"]["calibrated"], *told["spring_rms_mm"].values()]).all()
    assert set(calibration_figures(tmp_path, TINY)) == {"configurations", "lengths", "sensor"}


def test_drawn_poses_are_far_apart_and_known():
    found = compared(n=9)
    assert spread_poses(found, 3) == [0, 8, 4]
    found.tip_pair_m[0, 8] = np.nan
    assert 8 not in spread_poses(found, 4)


def test_without_a_network_two_simulations_are_drawn():
    found = compared()._replace(corrected_tip_m=np.full((6, 3), np.nan))
    texts = [text.get_text() for text in configurations_figure(found, "twin 0").legends[0].get_texts()]
    assert texts == ["simulated, as specified", "simulated, calibrated", "measured markers and tip"]
