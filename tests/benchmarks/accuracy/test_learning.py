"""Figures of finished runs, as `python -m benchmarks learning` gathers them."""

import pytest

from benchmarks.accuracy.learning import measure
from mjx_softarm._support.errors import InputError


def test_no_runs_are_refused_before_results_are_overwritten():
    with pytest.raises(InputError, match="--runs: got none, expected folders of runs"):
        measure(())
