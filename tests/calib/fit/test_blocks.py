import numpy as np
import pytest

from calib.fit.blocks import held_out_blocks


@pytest.mark.parametrize("n", [2, 3, 7, 99, 150, 201, 1_000, 4_338, 15_001])
@pytest.mark.parametrize("share", [0.01, 0.2, 0.99])
def test_both_parts_have_rows(n, share):
    held_out = held_out_blocks(n, share)
    assert held_out.shape == (n,) and held_out.dtype == bool
    assert 0 < held_out.sum() < n


def test_blocks_are_whole_as_many_as_asked_for_and_chosen_by_the_seed():
    first, again, other = (held_out_blocks(15_000, 0.2, 100, seed) for seed in (3, 3, 4))
    assert sorted(first.reshape(150, 100).sum(axis=1)) == [0] * 120 + [100] * 30
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("arguments", [(1,), (100, 0.0), (100, 1.0), (100, 0.2, 0)])
def test_refuses(arguments):
    with pytest.raises(ValueError, match=r"held-out rows: got .* expected"):
        held_out_blocks(*arguments)
