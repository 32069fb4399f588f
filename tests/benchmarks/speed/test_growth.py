"""How an epoch grows: the exponents that are told."""

import pytest

from benchmarks.speed.growth import exponents


def _rows(arms, seconds, memory):
    return [{"arms": n, "epoch_s": seconds(n), "peak_mib": memory(n)} for n in arms]


def test_exponents_are_those_of_the_sizes_that_are_large_enough():
    rows = _rows((64, 1024, 8192, 65_536), lambda n: 1.0 if n == 64 else 1e-3 * n, lambda n: 800 + n**1.5)
    told = exponents(rows)
    assert told["time"] == pytest.approx(1.0)
    assert told["memory"] == pytest.approx(1.5, abs=0.05)


def test_sizes_that_did_not_run_give_no_exponent():
    assert exponents(_rows((64, 1024), float, float)) == {"time": None, "memory": None}
