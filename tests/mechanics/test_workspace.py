"""The reachable workspace: drawn evenly, as wide as the paper's; and the command line that draws it."""

import functools
import itertools

import matplotlib.image
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_softarm import ArmSpec
from mjx_softarm.__main__ import main
from mjx_softarm.mechanics.drawing.workspace_plot import outline
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.mjcf import build_model, spring_lengths
from mjx_softarm.mechanics.workspace import (
    BATCH,
    VOXEL_MM,
    extreme_poses,
    sample_evenly,
    sample_workspace,
    settle_many,
)

SPEC = ArmSpec.default()
SMALL = SPEC.replace(name="small", structure={"n_sections": 1, "links_per_section": 2})
LOW_KPA, HIGH_KPA = SPEC.chambers.pressure_min_kpa, SPEC.chambers.pressure_max_kpa
PAPER_MM = 400.0, 350.0  # lateral, vertical


@functools.cache
def pool(n=BATCH, seed=0):
    return sample_workspace(SPEC, n, seed)


def n_voxels(tip_mm):
    return len(np.unique(np.floor(tip_mm / VOXEL_MM), axis=0))


def test_every_sampled_pose_is_a_rest_of_c_mujoco():
    model = build_model(SPEC)
    data = mujoco.MjData(model)
    assert pool().pose.shape == (BATCH, 6)
    for k in range(0, BATCH, 16):
        data.qpos[:], data.ctrl[:], data.qvel[:] = pool().q[k], pool().pressure_kpa[k], 0.0
        mujoco.mj_forward(model, data)
        force = data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias
        assert np.abs(force).max() < 2e-3
        tip = data.site("tip")
        angles = Rotation.from_matrix(tip.xmat.reshape(3, 3)).as_euler("ZYX", degrees=True)
        np.testing.assert_allclose(pool().pose[k, :3], 1e3 * tip.xpos, atol=1e-3)
        np.testing.assert_allclose(pool().pose[k, 3:], angles, atol=1e-3)
        np.testing.assert_allclose(pool().spring_m[k], spring_lengths(data, 9, 9), atol=1e-6)
    assert pool().spring_m.min() > SPEC.springs.length_min_m - 1e-3
    assert pool().spring_m.max() < SPEC.springs.length_max_m + 1e-3
    assert ((pool().pressure_kpa >= LOW_KPA) & (pool().pressure_kpa <= HIGH_KPA)).all()


def test_even_poses_fill_more_of_the_volume_and_its_rim_than_those_of_the_training():
    even, trained = np.asarray(sample_evenly(SPEC, BATCH, 0).pose)[:, :3], pool().pose[:, :3]
    assert even.shape == trained.shape and n_voxels(even) > 1.05 * n_voxels(trained)
    _, counts = np.unique(np.floor(even / VOXEL_MM), axis=0, return_counts=True)
    assert counts.max() <= 8  # where the mean is between one and two
    for share in (1.0, 99.0):  # tips nearest to the base, and furthest from it
        at = [np.percentile(np.linalg.norm(tip_mm, axis=1), share) for tip_mm in (even, trained)]
        assert (at[0] < at[1]) == (share < 50.0)


def test_an_arm_stronger_than_its_springs_has_poses_of_which_even_ones_can_be_commanded():
    low_m, high_m = SPEC.springs.length_min_m, SPEC.springs.length_max_m
    stronger = SPEC.replace(chambers={"pressure_min_kpa": 1.4 * LOW_KPA, "pressure_max_kpa": 1.4 * HIGH_KPA})
    plain, even = (np.asarray(draw(stronger, 64, 0).spring_m) for draw in (sample_workspace, sample_evenly))
    assert plain.min() < low_m or plain.max() > high_m
    assert even.min() >= low_m and even.max() <= high_m


def test_sampled_poses_spread_further_and_more_evenly_than_uniform_pressures():
    uniform = np.random.default_rng(0).uniform(LOW_KPA, HIGH_KPA, (BATCH, 9))
    tip_mm = 1e3 * settle_many(SPEC, uniform).tip_position_m
    assert n_voxels(pool().pose[:, :3]) > 1.5 * n_voxels(tip_mm)
    assert (np.ptp(pool().pose[:, :3], axis=0) > np.ptp(tip_mm, axis=0)).all()


def test_an_arm_that_never_settles_is_refused_with_the_count():
    limp = {"axial_stiffness_n_per_m": 1.0, "bending_stiffness_nm_per_rad": 0.01}
    spec = SPEC.replace(name="limp", chambers={"stiffness_n_per_m": 1.0}, backbone=limp)
    with pytest.raises(ValueError, match=r"limp: got an arm that settles at 0 of 128 .* at 64 or more"):
        sample_workspace(spec, 64, seed=0)


def test_many_pressures_are_settled_each_in_its_place():
    n = BATCH + 3  # more than a batch, and not a whole number of them
    pressure = np.random.default_rng(0).uniform(LOW_KPA, HIGH_KPA, (n, 9))
    found = settle_many(SPEC, pressure)
    assert {len(field) for field in found} == {n}
    np.testing.assert_allclose(found.pressure_kpa, pressure, rtol=1e-6)
    last = settle_many(SPEC, pressure[-3:])
    np.testing.assert_allclose(found.q[-3:], last.q, atol=1e-6)


def coverage_mm(found):
    """Extent along y and z."""
    return 1e3 * np.ptp(found.tip_position_m[:, 1:], axis=0)


def test_the_arm_covers_the_paper_s_workspace_in_its_plane_of_symmetry():
    # The YZ plane mirrors chamber 0 of a section on itself, and chamber 1 on 2.
    levels = (LOW_KPA, 0.0, HIGH_KPA)
    section = [(a, b, b) for a, b in itertools.product(levels, repeat=2)]
    pressure = np.array(list(itertools.product(section, repeat=3))).reshape(-1, 9)
    found = settle_many(SPEC, pressure)
    assert found.settled.all()
    np.testing.assert_allclose(found.tip_position_m[:, 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(coverage_mm(found), PAPER_MM, atol=30.0)


@pytest.mark.slow
def test_the_arm_covers_the_paper_s_workspace():
    found = extreme_poses(SPEC)
    assert len(found.settled) == 3**9 and found.settled.all()
    np.testing.assert_allclose(coverage_mm(found), PAPER_MM, atol=30.0)
    # The lengths that may be commanded are all but a few of those that pressures reach, and no more.
    shortest, longest = SPEC.springs.length_min_m, SPEC.springs.length_max_m
    assert np.mean((found.spring_m >= shortest) & (found.spring_m <= longest)) > 0.9999
    assert found.spring_m.min() < shortest + 5e-3 and found.spring_m.max() > longest - 5e-3


def test_the_outline_of_a_notched_square_keeps_the_notch():
    x, y = np.meshgrid(np.arange(11.0), np.arange(11.0))
    points = np.stack([x, y], axis=-1)[~((x > 3) & (x < 7) & (y > 3))]  # a slot from the top, 3 to 7
    edges = outline(points, gap=1.0)
    lengths = np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1)
    around, slot, cut_corner = 4 * 10, 2 * 7, 2 - np.sqrt(2)  # the gap rounds the slot's corners off
    assert lengths.sum() == pytest.approx(around + slot - 2 * cut_corner)
    filled = outline(points, gap=10.0)
    assert np.linalg.norm(filled[:, 0] - filled[:, 1], axis=1).sum() == pytest.approx(4 * 10)


@pytest.mark.parametrize("points", [np.zeros((2, 2)), np.stack([np.arange(5.0)] * 2, axis=1)])
def test_points_on_a_line_have_no_outline(points):
    assert outline(points, gap=1.0).shape == (0, 2, 2)


@pytest.fixture
def run(capsys):
    """Function of arguments: exit code, and what was printed and complained about."""

    def call(*arguments):
        try:
            code = main([str(x) for x in arguments])
        except SystemExit as exit_:
            code = exit_.code
        return code, *capsys.readouterr()

    return call


def test_spec_writes_the_default_arm_with_its_sources_and_replaces_nothing(run, tmp_path):
    path = tmp_path / "arm.toml"
    assert run("spec", "--out", path)[0] == 0
    assert ArmSpec.from_toml(path) == SPEC
    assert "# paper" in path.read_text("utf-8")
    path.write_text("mine", "utf-8")
    code, _, complaint = run("spec", "--out", path)
    assert code == 2 and "exists already" in complaint
    assert path.read_text("utf-8") == "mine"


def test_workspace_draws_the_figure_and_prints_the_coverage(run, tmp_path, monkeypatch):
    SMALL.to_toml(tmp_path / "small.toml")
    code, printed, complaint = run("workspace", "--spec", tmp_path / "small.toml", "--out", tmp_path / "new")
    assert (code, complaint) == (0, "")
    assert "27 combinations of pressures, 0 not settled (0.00%)" in printed
    lateral, vertical = coverage_mm(extreme_poses(SMALL))
    assert f"lateral (y)   {lateral:6.1f} mm\n" in printed
    assert f"vertical (z)  {vertical:6.1f} mm\n" in printed
    assert matplotlib.image.imread(tmp_path / "new" / "workspace.png").shape[0] > 600

    SMALL.replace(springs={"length_max_m": 0.35}).to_toml(tmp_path / "far.toml")
    _, printed, _ = run("workspace", "--spec", tmp_path / "far.toml", "--out", tmp_path)
    assert "now 0.085 and 0.350: change them" in printed

    # The paper's numbers stand beside its own arm alone, here at fewer pressures.
    few = random_pressures(SPEC, 32, seed=0)
    monkeypatch.setattr("mjx_softarm.mechanics.workspace.extreme_poses", lambda arm: settle_many(arm, few))
    code, of_paper, _ = run("workspace", "--out", tmp_path)
    assert code == 0 and "paper 400.0 mm" in of_paper and "paper" not in printed


def test_picture_draws_the_arm_at_its_pressures(run, tmp_path):
    SMALL.to_toml(tmp_path / "small.toml")
    pressures = (20, -40, -40)
    arguments = ("--spec", tmp_path / "small.toml", "--out", tmp_path / "arm.png", "--pressures", *pressures)
    code, printed, complaint = run("picture", *arguments)
    if "expected OpenGL" in complaint:
        pytest.skip(complaint)
    assert code == 0
    x, y, z = 1e3 * settle_many(SMALL, np.array([pressures])).tip_position_m[0]
    assert f"tip at x {x:.1f}, y {y:.1f}, z {z:.1f} mm" in printed
    assert np.ptp(matplotlib.image.imread(tmp_path / "arm.png"), axis=(0, 1)).max() > 0.5


def test_an_arm_that_does_not_settle_by_itself_is_told_by_its_file(run, tmp_path):
    """A stiffness in N/mm instead of N/m; no pressure is to blame."""
    soft = {"mass": {"gripper_kg": 45.0}, "chambers": {"stiffness_n_per_m": 0.5}}
    SMALL.replace(backbone={"axial_stiffness_n_per_m": 0.8}, **soft).to_toml(tmp_path / "soft.toml")
    code, _, complaint = run("picture", "--spec", tmp_path / "soft.toml", "--out", tmp_path / "arm.png")
    if "expected OpenGL" in complaint:
        pytest.skip(complaint)
    assert code == 2 and complaint.startswith(f"error: {tmp_path / 'soft.toml'}: got an arm that does not")
    assert complaint.endswith("check the units of its masses, lengths and stiffnesses\n")


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (["picture", "--pressures", "1", "2"], "got 2 numbers, expected 1 or 9"),
        (["picture", "--pressures", "21"], "got 21, expected -40 to 20 kPa"),
        (["spec", "--out", "no/such/folder/arm.toml"], "No such file or directory"),
    ],
)
def test_a_mistake_is_told_in_one_line_with_exit_code_2(run, arguments, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, printed, complaint = run(*arguments)
    assert code == 2 and printed == ""
    assert expected in complaint and complaint.count("\n") == 1
