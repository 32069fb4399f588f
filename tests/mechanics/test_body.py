"""The drawn shape against closed forms."""

import numpy as np

from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.body import COILS, FOLDS, shape
from mjx_softarm.sensing.pose import frame_from_pose, pose_from_quaternion
from tests.linear_arm import REST_M, SPEC, N

UNKNOWN = np.full(6, np.nan)


def test_straight_arm():
    parts = shape(SPEC, np.full(N, 0.15), UNKNOWN)
    np.testing.assert_allclose(parts.rings.position_m[:, 2], -0.45 * np.arange(1, 13) / 12, atol=1e-12)
    np.testing.assert_allclose(parts.rings.quaternion[:, 0], 1.0, atol=1e-12)
    np.testing.assert_allclose(parts.folds.scale[:, 2], 0.15 / FOLDS)
    np.testing.assert_allclose(parts.coils.scale[:, 2], 0.15 / COILS)
    first = parts.folds.position_m[0]  # of chamber 0, on +y
    np.testing.assert_allclose(first, [0.0, SPEC.geometry.chamber_radius_m, -0.15 * 0.5 / FOLDS], atol=1e-12)
    radius_m = np.hypot(*parts.coils.position_m[:, :2].T)
    np.testing.assert_allclose(radius_m, SPEC.geometry.spring_radius_m)


def test_bent_section_is_an_arc():
    """A spring at distance r from the axis of an arc of radius R and angle a has the length (R - r) a."""
    one = ArmSpec.default().replace(structure={"n_sections": 1, "links_per_section": 10})
    radius_m, angle = 0.3, 0.8
    r = one.geometry.spring_radius_m * np.cos(2 * np.pi * np.arange(3) / 3)
    centres = shape(one, (radius_m - r) * angle, UNKNOWN).rings.position_m
    part = angle * np.arange(1, 11) / 10
    np.testing.assert_allclose(centres[:, 1], radius_m * (1 - np.cos(part)), atol=1e-9)
    np.testing.assert_allclose(centres[:, 2], -radius_m * np.sin(part), atol=1e-9)


def test_arm_ends_at_the_tip_s_pose():
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = np.array([0, 0, -500, 0, 0, 0]) + rng.uniform(-1, 1, 6) * [80, 80, 60, 170, 60, 170]
        rings = shape(SPEC, REST_M + rng.uniform(-0.05, 0.03, N), pose).rings
        position_m, rotation = frame_from_pose(pose)
        np.testing.assert_allclose(rings.position_m[-1], position_m, atol=1e-9)
        found = frame_from_pose(pose_from_quaternion(rings.position_m[-1], rings.quaternion[-1]))[1]
        np.testing.assert_allclose(found, rotation, atol=1e-9)
