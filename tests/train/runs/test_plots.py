"""Pictures of a run: axes that a reader can read numbers from."""

import itertools

import numpy as np
import pytest

from train.runs.evaluate import Reached
from train.runs.plots import workspace_figure

N = 500


def with_errors(error_mm):
    """Return arms above goals that are spread over the workspace."""
    goal = np.zeros((N, 6))
    goal[:, :3] = np.random.default_rng(1).uniform([-250, -250, -700], [250, 250, -400], (N, 3))
    pose = goal + np.outer(error_mm, [0, 0, 1, 0, 0, 0])
    each, once = np.full(N, np.nan), np.full(N, True)
    return Reached(goal, pose, each, 0 * once, once, np.zeros((N, 9)), each, each, each)


@pytest.mark.parametrize(("median_mm", "spread"), [(0.0, 0.0), (0.19, 1.0), (1.3, 0.3), (12.0, 1.0)])
def test_the_distribution_of_the_error_can_be_read(median_mm, spread):
    """Median and 95 % lie inside, and numbers stand below, beside and above them."""
    error_mm = median_mm * np.exp(spread * np.random.default_rng(0).normal(size=N))
    figure = workspace_figure(with_errors(error_mm))
    figure.draw_without_rendering()
    axes = figure.axes[2]
    low, high = axes.get_xlim()
    labels = axes.xaxis.get_major_ticks()
    numbers = [float(tick.label1.get_text()) for tick in labels if low <= tick.get_loc() <= high]
    assert 3 <= len(numbers) <= 12
    if median_mm:
        middle, rim = np.quantile(error_mm, (0.5, 0.95))
        assert low < middle <= rim < high and min(numbers) < middle and rim < max(numbers) * 2.5
        # As far apart as a logarithm has them: a factor of two is seen.
        assert np.log(rim / middle) / np.log(high / low) >= 0.1 * (spread > 0.0)
    # No two numbers run into each other.
    boxes = [tick.label1.get_window_extent() for tick in labels if low <= tick.get_loc() <= high]
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))
