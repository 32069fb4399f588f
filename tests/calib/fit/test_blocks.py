import numpy as np
import pytest

from calib.fit.blocks import folds, held_out_blocks


@pytest.mark.parametrize("n", [2, 3, 7, 99, 150, 201, 1_000, 4_338, 15_001])
def test_both_parts_have_rows(n):
    held_out = held_out_blocks(n)
    assert held_out.shape == (n,) and held_out.dtype == bool
    assert 0 < held_out.sum() < n


def test_blocks_are_whole_as_many_as_asked_for_and_chosen_by_the_seed():
    first, again, other = (held_out_blocks(15_000, 100, seed) for seed in (3, 3, 4))
    assert sorted(first.reshape(150, 100).sum(axis=1)) == [0] * 120 + [100] * 30
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_folds_reach_over_the_whole_range_of_a_quantity():
    """A staircase of ten steps: without its order a fold may hold out both ends, or one step alone."""
    by = np.repeat(np.arange(10.0), 100)
    for seed in range(5):
        fold = folds(by, 50, 5, seed)
        assert np.bincount(fold).tolist() == [200] * 5
        for k in range(5):
            assert by[fold != k].min() == 0.0 and by[fold != k].max() == 9.0
            assert np.ptp(by[fold == k]) >= 5.0
