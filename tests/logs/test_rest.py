"""Cutting of logs into holds of pressures."""

import numpy as np

from mjx_softarm.logs.rest import MIN_HOLD_S, holds


def test_holds_of_long_logs_are_those_found_row_by_row():
    rng = np.random.default_rng(2)
    n = 2000
    pressure = np.repeat(rng.uniform(-40, 20, (40, 9)), 50, axis=0) + rng.uniform(-0.3, 0.3, (n, 9))
    pressure[500:900] = pressure[500] + rng.uniform(-0.3, 0.3, (400, 9))
    time_s = np.cumsum(rng.choice([0.02, MIN_HOLD_S + 1.0], n, p=[0.99, 0.01]))
    payload = np.repeat([0.0, 0.1], n // 2)
    starts = [0]
    for k in range(1, n):
        new = time_s[k] - time_s[k - 1] > MIN_HOLD_S or payload[k] != payload[k - 1]
        if new or np.abs(pressure[k] - pressure[starts[-1]]).max() > 1.0:
            starts.append(k)
    assert holds(time_s, pressure, payload) == list(zip(starts, [*starts[1:], n], strict=True))
