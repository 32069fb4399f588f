"""Chamber lengths from markers: good on simple curves, as coarse as said on simulated arms."""

import mujoco
import numpy as np
import pytest

from calib.fit.markers import (
    N_POSES,
    chamber_lengths,
    fit_curve,
    marker_limits,
    section_ends,
    section_shares,
)
from calib.read.static_poses import StaticPoses
from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.workspace import settle_many
from tests.arms import FOUR_CHAMBERS, TAPERED

SPEC = ArmSpec.default().replace(structure={"links_per_section": 6})  # markers are at thirds of a section
SITE_M = ArmParams.from_spec(SPEC, np.float64).chamber_site_m.reshape(-1, 2)
N = 60


@pytest.fixture(scope="module")
def arm():
    """Settled arms, and their C MuJoCo model."""
    swing = np.cos(np.random.default_rng(0).uniform(0.0, np.pi, (N, 9)))
    pressure_kpa = -10.0 + 30.0 * swing
    found = settle_many(SPEC, pressure_kpa)
    assert found.settled.all()
    return pressure_kpa, found, build_model(SPEC)


def poses_with_markers(arm, kind):
    """Poses with nine markers at the first chamber or spring of each section; true chamber lengths."""
    pressure_kpa, found, model = arm
    data = mujoco.MjData(model)
    marker_m, length_m = np.empty((N, 9, 3)), np.empty((N, 9))
    for k, q in enumerate(found.q):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        marker_m[k] = [data.site(f"{kind}{3 * (j // 3)}_plate{2 * (j + 1)}").xpos for j in range(9)]
        length_m[k] = data.ten_length[: data.ctrl.size]
    poses = StaticPoses(
        pressure_kpa, np.zeros(N), np.float64(found.tip_position_m), np.float64(found.tip_rotation),
        found.spring_m, marker_m, np.zeros((N, 1, 9)), np.ones(N, int),
    )  # fmt: skip
    return poses, length_m


def bent(bend_rad, length_m, site_m):
    """Markers (9, 3) of an arm bent to a circle about the x axis, towards +y."""
    angle = bend_rad * np.arange(1, 10) / 9
    radius = length_m / bend_rad - site_m[1]  # to the markers, from the circle's centre
    y_m = length_m / bend_rad - radius * np.cos(angle)
    return np.column_stack([np.full(9, site_m[0]), y_m, -radius * np.sin(angle)])


def test_a_straight_arm_has_its_length_everywhere():
    site = np.array([0.03, 0.02])
    for arm in (SPEC, TAPERED, FOUR_CHAMBERS):
        share = section_shares(arm, 3)
        marker_m = np.outer(share[1:], [0.0, 0.0, -1.05 * arm.length_m]) + [*site, 0.0]
        curve, left = fit_curve(marker_m, site, share)
        expected = 1.05 * arm.at_chambers(arm.geometry.section_length_m)
        np.testing.assert_allclose(chamber_lengths(curve, site, arm), expected, rtol=1e-9)
        assert np.abs(left).max() < 1e-12


@pytest.mark.parametrize("site", [(0.0, 0.0), (0.0, 0.067), (0.03, -0.02)])
def test_a_circle_s_chambers_differ_by_their_distance_from_its_centre(site):
    """A chamber y nearer to the centre of a bend by b is shorter by y b."""
    curve, left = fit_curve(bent(1.2, 0.6, site), np.array(site), section_shares(SPEC, 3))
    expected = (0.6 - 1.2 * SITE_M[:, 1]) / 3
    np.testing.assert_allclose(chamber_lengths(curve, np.array(site), SPEC), expected, rtol=0.01)
    assert np.abs(left).max() < 3e-4


@pytest.mark.parametrize(("kind", "rms_m", "residual_mm"), [("chamber", 0.008, 4.0), ("spring", 0.015, 5.0)])
def test_simulated_arms_are_met_as_coarsely_as_the_module_says(arm, kind, rms_m, residual_mm):
    poses, length_m = poses_with_markers(arm, kind)
    limits = marker_limits(poses, length_m, SPEC)
    expected_site = getattr(ArmParams.from_spec(SPEC, np.float64), f"{kind}_site_m")[0, 0]
    np.testing.assert_allclose(limits.marker_site_m, expected_site, atol=1e-6)
    assert len(limits.pose) == N_POSES
    assert (np.diff(limits.bending_deg) <= 0).all()
    np.testing.assert_array_equal(limits.simulated_m, length_m[limits.pose])
    error_m = limits.length_m - length_m[limits.pose]
    assert 0.002 < np.sqrt(np.mean(error_m**2)) < rms_m  # better would need another text
    assert limits.residual_mm.mean() < residual_mm
    assert limits.length_min_m == limits.length_m.min()
    assert limits.length_max_m == limits.length_m.max()


def test_every_third_of_nine_markers_is_at_a_section_s_end(arm):
    poses, _ = poses_with_markers(arm, "chamber")
    np.testing.assert_array_equal(section_ends(poses, SPEC), poses.marker_m[:, [2, 5, 8]])
    assert np.isnan(section_ends(poses._replace(marker_m=np.zeros((N, 0, 3))), SPEC)).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m[:, :8], "got 8, expected as many in each of 3 sections"),
        (lambda m: m + np.nan, "got no pose at rest that has them"),
        (lambda m: m + [0.0, 0.0, 0.3], "mm above the tip's plate, expected it in the"),
    ],
)
def test_refuses_markers_that_are_not_at_the_sections_ends(arm, change, message):
    poses, _ = poses_with_markers(arm, "chamber")
    with pytest.raises(ValueError, match=message):
        section_ends(poses._replace(marker_m=change(poses.marker_m)), SPEC)
