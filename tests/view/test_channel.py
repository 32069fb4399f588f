"""A channel of which neither end waits for the other."""

import time

import numpy as np

from tests.view.conftest import wait_for


def test_other_end_that_reads_nothing_costs_no_time_and_no_memory(ends):
    end, other = ends
    longest = 0.0
    for k in range(3000):  # far more than a pipe holds
        began = time.perf_counter()
        end.put(look=np.full(100, float(k)))
        longest = max(longest, time.perf_counter() - began)
    assert longest < 0.1  # a write that waited would never return
    assert len(end._out) <= 1
    seen = []
    wait_for(lambda: seen.append(other.recv()["look"][0]) or seen[-1] == 2999.0)
    assert len(seen) < 3000 and seen == sorted(seen)


def test_lost_end_is_seen(ends):
    end, other = ends
    other.close()
    assert end.closed.wait(5.0)
    end.put(look=1)
    assert end.take() == {}
