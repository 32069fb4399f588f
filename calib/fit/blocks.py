"""Held-out rows of a log, in contiguous blocks.

Neighbouring rows of a log are nearly equal. A row held out alone has its neighbours in the training set, and
any fit looks good on it; so whole stretches of time are held out.
"""

from __future__ import annotations

import numpy as np

SHARE = 0.2  # share of the rows that is held out
MIN_BLOCKS = 20  # least number of blocks of a log: blocks are shorter rather than fewer


def block_rows(n: int, longest: int = 100) -> int:
    """Return the number of rows in a block of a log of n rows."""
    return max(min(longest, n // MIN_BLOCKS), 1)


def held_out_blocks(n: int, block: int = 100, seed: int = 0) -> np.ndarray:
    """Return a mask (n,) of the rows to hold out of a log of two rows or more: random blocks, a share of all.

    Rows 0 to block - 1 are the first block, and so on; the last may be shorter. At least one is held out
    and at least one is not. A log of fewer than two blocks is cut into blocks of a fifth of it.
    """
    if n < 2 * block:
        block = min(block, max(n // 5, 1))
    n_blocks = -(-n // block)
    n_held_out = min(max(round(SHARE * n_blocks), 1), n_blocks - 1)
    chosen = np.random.default_rng(seed).choice(n_blocks, n_held_out, replace=False)
    return np.isin(np.arange(n) // block, chosen)


def folds(by: np.ndarray, block: int, n_folds: int, seed: int) -> np.ndarray:
    """Return the fold (n,) that holds out each row: every row once, in whole blocks, drawn at random.

    Blocks are as in `held_out_blocks`. A log of fewer blocks than folds is cut into one block for each fold.
    Blocks are sorted by their mean of a quantity `by` (n,), and each `n_folds` neighbours go to different
    folds: every fold reaches over the whole range.
    """
    n = len(by)
    n_blocks = max(-(-n // block), n_folds)
    rng, block_of_row = np.random.default_rng(seed), np.arange(n) * n_blocks // n
    mean = np.bincount(block_of_row, by) / np.bincount(block_of_row)
    fold_of_block = np.empty(n_blocks, int)
    for start in range(0, n_blocks, n_folds):
        neighbours = np.argsort(mean)[start : start + n_folds]
        fold_of_block[neighbours] = rng.permutation(n_folds)[: len(neighbours)]
    return fold_of_block[block_of_row]
