"""Meshes of the picture."""

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs viser: pip install -e '.[view]'")
from mjx_softarm.view.meshes import workspace_hull


def test_hull_follows_a_hollow():
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (3000, 3))
    points = points[(np.abs(points[:, 0]) > 0.4) | (points[:, 2] < 0.0)]  # a valley along y
    hull = workspace_hull(points)
    middle = hull.triangles_center
    _, faces_at_edge = np.unique(np.sort(hull.edges, axis=1), axis=0, return_counts=True)
    assert np.abs(middle).max() > 0.9 and not (faces_at_edge % 2).any()  # closed
    inside = (np.abs(middle[:, 0]) < 0.2) & (middle[:, 2] > 0.4)
    assert not inside.any()
