import numpy as np
import pytest

from calib.fit.blocks import held_out_blocks


@pytest.mark.parametrize("n", [2, 3, 7, 99, 150, 201, 1_000, 4_338, 15_001])
@pytest.mark.parametrize("share", [0.01, 0.2, 0.99])
def test_both_parts_have_rows(n, share):
    held_out = held_out_blocks(n, share)
    assert held_out.shape == (n,) and held_out.dtype == bool
    assert 0 < held_out.sum() < n


def test_blocks_are_whole_and_as_many_as_asked_for():
    held_out = held_out_blocks(15_000, share=0.2, block=100, seed=3)
    per_block = held_out.reshape(150, 100).sum(axis=1)
    assert set(per_block) == {0, 100}
    assert (per_block == 100).sum() == 30


def test_seed_chooses_the_blocks():
    first, again, other = (held_out_blocks(5_000, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n": 1}, "got a log of 1 rows"),
        ({"n": 100, "share": 0.0}, "got a share of 0.0"),
        ({"n": 100, "share": 1.0}, "got a share of 1.0"),
        ({"n": 100, "block": 0}, "got blocks of 0 rows"),
    ],
)
def test_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        held_out_blocks(**arguments)
