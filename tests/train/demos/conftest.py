"""Fixtures for tests of demonstrations: one expert, compiled once."""

import numpy as np
import pytest

from mjx_softarm.mechanics.pipe import CrossPipe
from mjx_softarm.sensing.s2r import N_POSE_INPUTS, N_POSE_OUTPUTS
from tests.networks import s2r_of
from train.demos.expert import Expert
from train.demos.waypoints import SQUARE, Waypoint, task

SHIFT_MM = (4.0, -3.0, 2.0)


@pytest.fixture(scope="session")
def shift_mm():
    """Shift (3,) [mm] that the network of `expert` adds to every simulated tip."""
    return np.array(SHIFT_MM)


@pytest.fixture(scope="session")
def shifting_s2r(spec):
    """A sim-to-real network that moves every tip alike."""
    n_in = N_POSE_INPUTS + spec.n_chambers
    output = np.float32([*SHIFT_MM, 0.0, 0.0, 0.0])
    return s2r_of(((np.zeros((n_in, N_POSE_OUTPUTS), np.float32), output),), 10.0)


@pytest.fixture(scope="session")
def expert(spec, shifting_s2r):
    """The paper's arm in the 300 mm pipe, believed to be off by `shift_mm`."""
    return Expert(spec, shifting_s2r, CrossPipe(300))


@pytest.fixture(scope="session")
def waypoints(spec):
    """From home into the right container, and straight down half of the way to the bottom."""
    picked = task("pipe300", spec)[0][:5]
    return (*picked, Waypoint("down", np.array([0.0, 0.0, -0.72]), SQUARE))


@pytest.fixture(scope="session")
def plan(expert, waypoints):
    return expert.plan(waypoints)
