"""Markers at the sections' ends: which of a pose's markers they are, and which logs have none."""

import mujoco
import numpy as np
import pytest

from calib.fit.chambers import section_ends
from calib.read.static_poses import StaticPoses
from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.workspace import settle_many

SPEC = ArmSpec.default().replace(structure={"links_per_section": 6})  # markers are at thirds of a section
N = 8


@pytest.fixture(scope="module")
def poses():
    """Poses of C MuJoCo with nine markers, three at the first chamber of each section."""
    pressure_kpa = -10.0 + 30.0 * np.cos(np.random.default_rng(0).uniform(0.0, np.pi, (N, 9)))
    found, model = settle_many(SPEC, pressure_kpa), build_model(SPEC)
    data, marker_m = mujoco.MjData(model), np.empty((N, 9, 3))
    for k, q in enumerate(found.q):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        marker_m[k] = [data.site(f"chamber{3 * (j // 3)}_plate{2 * (j + 1)}").xpos for j in range(9)]
    return StaticPoses(
        pressure_kpa, np.zeros(N), np.float64(found.tip_position_m), np.float64(found.tip_rotation),
        found.spring_m, marker_m, np.zeros((N, 1, 9)), np.ones(N, int),
    )  # fmt: skip


def test_every_third_of_nine_markers_is_at_a_section_s_end(poses):
    np.testing.assert_array_equal(section_ends(poses, SPEC)[0], poses.marker_m[:, [2, 5, 8]])
    end_m, reasons = section_ends(poses._replace(marker_m=np.zeros((N, 0, 3))), SPEC)
    assert np.isnan(end_m).all() and not reasons


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m[:, :8], "got 8, expected as many in each of 3 sections"),
        (lambda m: m + np.nan, "got no pose at rest that has them"),
        (lambda m: m + [0.0, 0.0, 0.3], "mm above the tip's plate, expected it in the"),
    ],
)
def test_refuses_markers_that_are_not_at_the_sections_ends(poses, change, message):
    end_m, (reason,) = section_ends(poses._replace(marker_m=change(poses.marker_m)), SPEC)
    assert np.isnan(end_m).all() and message in reason
