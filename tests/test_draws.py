"""Random numbers drawn as one row against jax.random's own."""

import jax
import numpy as np

from mjx_softarm import draws

KEY = jax.random.PRNGKey(3)
SHAPE = (7, 5, 3)


def test_numbers_are_those_of_jax_random():
    np.testing.assert_array_equal(draws.uniform(KEY, SHAPE), jax.random.uniform(KEY, SHAPE))
    ranged = jax.random.uniform(KEY, SHAPE, minval=-1.0, maxval=2.0)
    np.testing.assert_array_equal(draws.uniform(KEY, SHAPE, -1.0, 2.0), ranged)
    np.testing.assert_array_equal(draws.normal(KEY, SHAPE), jax.random.normal(KEY, SHAPE))
