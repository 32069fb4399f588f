"""Held-out rows of a log, in contiguous blocks.

Neighbouring rows of a log are nearly equal. A row held out alone has its neighbours in the training set, and
any fit looks good on it; so whole stretches of time are held out.
"""

from __future__ import annotations

import numpy as np

MIN_BLOCKS = 20  # least number of blocks of a log: blocks are shorter rather than fewer


def block_rows(n: int, longest: int = 100) -> int:
    """Return the number of rows in a block of a log of n rows."""
    return max(min(longest, n // MIN_BLOCKS), 1)


def held_out_blocks(n: int, share: float = 0.2, block: int = 100, seed: int = 0) -> np.ndarray:
    """Return a mask (n,) of the rows to hold out: a share of the blocks, drawn at random.

    Rows 0 to block - 1 are the first block, and so on; the last may be shorter. At least one is held out
    and at least one is not. A log of fewer than two blocks is cut into blocks of a fifth of it.

    Raises:
        ValueError: fewer than two rows, a share outside (0, 1), a block below one row.
    """
    if n < 2:
        raise ValueError(f"held-out rows: got a log of {n} rows, expected 2 or more")
    if not 0 < share < 1:
        raise ValueError(f"held-out rows: got a share of {share}, expected one between 0 and 1")
    if block < 1:
        raise ValueError(f"held-out rows: got blocks of {block} rows, expected 1 or more")
    if n < 2 * block:
        block = min(block, max(n // 5, 1))
    n_blocks = -(-n // block)
    n_held_out = min(max(round(share * n_blocks), 1), n_blocks - 1)
    chosen = np.random.default_rng(seed).choice(n_blocks, n_held_out, replace=False)
    return np.isin(np.arange(n) // block, chosen)


def folds(
    n: int, block: int = 100, n_folds: int = 5, seed: int = 0, by: np.ndarray | None = None
) -> np.ndarray:
    """Return the fold (n,) that holds out each row: every row once, in whole blocks, drawn at random.

    Blocks are as in `held_out_blocks`. A log of fewer blocks than folds is cut into one block for each fold.
    With `by` (n,), blocks are sorted by their mean of it, and each `n_folds` neighbours go to different
    folds: every fold reaches over the whole range.

    Raises:
        ValueError: fewer than two folds, or fewer rows than folds.
    """
    if not 2 <= n_folds <= n:
        raise ValueError(f"held-out rows: got {n_folds} folds, expected 2 to {n}, the number of rows")
    n_blocks = max(-(-n // block), n_folds)
    rng, block_of_row = np.random.default_rng(seed), np.arange(n) * n_blocks // n
    if by is None:
        return (rng.permutation(n_blocks) % n_folds)[block_of_row]
    mean = np.bincount(block_of_row, by) / np.bincount(block_of_row)
    fold_of_block = np.empty(n_blocks, int)
    for start in range(0, n_blocks, n_folds):
        neighbours = np.argsort(mean)[start : start + n_folds]
        fold_of_block[neighbours] = rng.permutation(n_folds)[: len(neighbours)]
    return fold_of_block[block_of_row]
