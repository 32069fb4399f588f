"""Planned poses: their choice by hand on small problems, and the way from a calibration to a recording."""

import numpy as np
import pytest

from calib.__main__ import main
from calib.arm import CalibratedArm
from calib.fit.held_pressures import fit_held_pressures
from calib.plan import (
    RECORDED_FILE,
    Recorded,
    choose_far,
    choose_informative,
    load_recorded,
    n_unknown,
    plan,
    save_recorded,
)
from mjx_softarm import ArmSpec
from mjx_softarm._support.archive import SealedFileError
from mjx_softarm._support.errors import InputError
from mjx_softarm.logs.pressure_plan import read_plan, write_plan
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.workspace import settle_many

SMALL = ArmSpec.default().replace(structure={"n_sections": 1, "links_per_section": 2})


def test_the_pose_that_tells_the_unknown_direction_is_chosen_first():
    """Three candidates, each of which measures one of three parameters; the second is the unknown one."""
    options = np.zeros((3, 1, 3))
    options[[0, 1, 2], 0, [0, 1, 2]] = 4.0
    covariance = np.diag([0.05, 50.0, 0.3])
    chosen, after = choose_informative(options, covariance, 3)
    assert chosen[0] == 1 and after[1, 1] == pytest.approx(1.0 / (1.0 / 50.0 + 16.0))
    np.testing.assert_allclose(after, np.linalg.inv(np.linalg.inv(covariance) + 16.0 * np.diag([0, 1, 1])))


def test_no_pose_is_spent_once_all_directions_are_known():
    chosen, after = choose_informative(np.ones((4, 1, 2)), 1e-3 * np.eye(2), 3)
    assert len(chosen) == 0 and n_unknown(after) == 0
    assert n_unknown(np.diag([1.0, 1e-4])) == 1


def test_far_poses_keep_away_from_those_recorded_and_go_where_the_error_is():
    near, far = np.full((40, 3), -10.0), np.full((40, 3), 10.0)
    candidates = np.concatenate([near, far]) + np.random.default_rng(0).normal(size=(80, 3))
    recorded = Recorded(near[:10], np.zeros(10), np.ones(10), np.ones(3))
    found = choose_far(SMALL, recorded, candidates, np.array([], int), 1, np.random.default_rng(1))
    assert found[0] >= 40
    both = np.concatenate([near[:10], far[:10]])
    bad = Recorded(both, np.zeros(20), np.repeat([9.0, 1.0], 10), np.ones(3))
    drawn = [
        choose_far(SMALL, bad, candidates, np.array([], int), 1, np.random.default_rng(k))[0]
        for k in range(60)
    ]
    assert np.mean(np.array(drawn) < 40) > 0.65


def test_poses_that_differ_in_redundant_pressures_alone_are_not_far(four_chamber_arm):
    """Equal pressures in opposite chambers of four, and others in the chambers beside them, move nothing."""
    base = np.zeros((10, 12))
    alternating, bent = base + 30.0 * np.tile([1.0, -1.0], 6), base + 10.0 * np.tile([1.0, 0.0, -1.0, 0.0], 3)
    candidates = np.concatenate([alternating, bent]) + np.random.default_rng(0).normal(size=(20, 12))
    recorded = Recorded(base, np.zeros(10), np.ones(10), np.ones(3))
    drawn = [
        choose_far(four_chamber_arm, recorded, candidates, np.array([], int), 1, np.random.default_rng(k))[0]
        for k in range(40)
    ]
    assert np.mean(np.array(drawn) >= 10) > 0.9


@pytest.fixture(scope="module")
def recorded():
    rng = np.random.default_rng(0)
    pressure_kpa = rng.uniform(-5.0, 5.0, (30, 3))
    return Recorded(pressure_kpa, np.zeros(30), np.ones(30), np.tile([1e-3, 0.01, 1e-3], (2, 1)))


def test_a_plan_makes_directions_known(recorded):
    """Poses of small pressures do not tell how areas change with length."""
    found = plan(CalibratedArm(SMALL), recorded, 30, seed=0)
    assert found.pressure_kpa.shape == (30, 3)
    assert found.n_unknown[1] < found.n_unknown[0]
    assert 1 <= found.n_informative <= 15
    assert np.abs(found.pressure_kpa[: found.n_informative]).mean() > 10.0


def test_markers_of_the_calibration_count_for_the_plan_too(recorded, tmp_path):
    """Markers that are known ten times as well as the tip tell more than tip and springs alone."""
    with_markers = recorded._replace(scale=np.tile([1e-3, 0.01, 1e-3, 1e-4], (2, 1)))
    save_recorded(tmp_path / RECORDED_FILE, with_markers)
    loaded = load_recorded(tmp_path / RECORDED_FILE, SMALL)
    np.testing.assert_array_equal(loaded.scale, with_markers.scale)
    unknown = [plan(CalibratedArm(SMALL), known, 30, seed=0).n_unknown for known in (recorded, loaded)]
    assert unknown[1][0] < unknown[0][0] and unknown[1][1] < unknown[0][1]


def test_straight_poses_are_worth_more_where_the_model_fits_them_better(recorded):
    """The recorded pressures are so small that the arm hardly bends."""
    better = recorded._replace(scale=recorded.scale * [[1.0], [0.1]])
    unknown = [plan(CalibratedArm(SMALL), known, 30, 0).n_unknown[0] for known in (recorded, better)]
    assert unknown[1] < unknown[0]


def test_from_a_calibration_to_a_file_that_record_reads(recorded, tmp_path, capsys):
    SMALL.to_toml(tmp_path / "arm.toml")
    save_recorded(tmp_path / RECORDED_FILE, recorded)
    out = tmp_path / "next.csv"
    assert main(["plan", str(tmp_path), "--poses", "30", "--out", str(out)]) == 0
    assert "unknown directions" in capsys.readouterr().out
    pressure_kpa = read_plan(out, SMALL)
    assert pressure_kpa.shape == (30, 3)
    assert main(["plan", str(tmp_path), "--out", str(out)]) == 2
    assert "expected a new file" in capsys.readouterr().err
    with pytest.raises(SealedFileError, match="recorded.pressure_kpa: got float64"):
        load_recorded(tmp_path / RECORDED_FILE, ArmSpec.default())


def test_the_covariance_of_other_parameters_is_left_out(recorded, tmp_path):
    """An earlier version had fewer; a plan then takes that of its poses."""
    save_recorded(tmp_path / RECORDED_FILE, recorded._replace(covariance=np.eye(3)))
    loaded = load_recorded(tmp_path / RECORDED_FILE, SMALL)
    assert loaded.covariance is None
    assert plan(CalibratedArm(SMALL), loaded, 5, seed=0).pressure_kpa.shape == (5, 3)


def test_pressures_beyond_the_limits_or_of_another_arm_are_refused(tmp_path):
    write_plan(tmp_path / "a.csv", np.array([[0.0, 1.0, 2.0], [0.0, 30.0, 0.0]]))
    with pytest.raises(InputError, match=r"a.csv: line 3: pressure1 \[kPa\]: got 30, expected -40 to 20"):
        read_plan(tmp_path / "a.csv", SMALL)
    with pytest.raises(InputError, match="expected pressure0"):
        read_plan(tmp_path / "a.csv", ArmSpec.default())


def test_poses_are_planned_for_the_payload_where_it_is_not_known():
    """Residual pressures of a kilopascal without any pattern hide it, those of a pascal do not."""
    pressure_kpa = random_pressures(SMALL, 60, 0)
    spring_m = settle_many(SMALL, pressure_kpa).spring_m
    scale = np.tile([1e-5, 1e-4, 1e-5], (2, 1))  # all directions are known
    recorded = Recorded(pressure_kpa, np.zeros(60), np.ones(60), scale)
    left_kpa = np.random.default_rng(1).normal(0.0, [[[1.0]], [[1e-3]]], (2, 60, 3))
    for left, n_payload in zip(left_kpa, (10, 0), strict=True):
        held = fit_held_pressures(SMALL, spring_m, pressure_kpa + left, pressure_kpa).held
        found = plan(CalibratedArm(SMALL, held=held), recorded, 20, 0)
        assert found.n_informative == 0 and found.n_payload == n_payload
        now_kg, then_kg = found.half_width_kg
        assert then_kg < now_kg if n_payload else then_kg == now_kg
