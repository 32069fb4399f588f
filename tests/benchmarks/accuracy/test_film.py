"""Goals of the film: far from each other, or refused."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.accuracy.film import FAR_MM, N_GOALS, far_goals
from mjx_softarm._support.errors import InputError


def test_each_goal_is_far_from_the_one_before():
    poses = np.random.default_rng(0).uniform(-200.0, 200.0, (200, 6))
    goals = far_goals(jnp.asarray(poses))
    assert len(goals) == N_GOALS
    assert (np.linalg.norm(np.diff(goals[:, :3], axis=0), axis=-1) > FAR_MM).all()
    with pytest.raises(InputError, match="poses: got 1 that are 150 mm apart, expected 5"):
        far_goals(jnp.asarray(poses / 100.0))
