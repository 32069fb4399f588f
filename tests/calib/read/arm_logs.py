"""Logs of a moving arm without faults, and small files, for the tests of reading."""

import dataclasses

import numpy as np

from mjx_softarm.logs.schema import Log

HEADER = "time [s],tip_x [m],tip_y [m],tip_z [m]"
N = 400


def arm_log(n=N, seed=0, rate_hz=50.0, **changes):
    """A moving arm of nine chambers with noise, markers on three plates, the last being the tip."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(n) / rate_hz
    swing = np.sin(2.0 * np.pi * (0.3 * time_s[:, None] + rng.uniform(size=9)))
    half = 0.4 * swing[:, 0] + 1e-3 * rng.standard_normal(n)
    tip_m = np.stack([0.1 * swing[:, 1], 0.2 * swing[:, 0], -0.6 + 0.05 * swing[:, 2]], axis=1)
    tip_m += 1e-4 * rng.standard_normal((n, 3))
    log = Log(
        source="arm.csv",
        row=np.arange(n) + 2,
        time_s=time_s,
        readings=4e6 + 3e5 * swing + 1e3 * rng.standard_normal((n, 9)),
        spring_m=0.2 + 0.03 * swing + 3e-4 * rng.standard_normal((n, 9)),
        pressure_kpa=-10.0 + 15.0 * swing + 0.1 * rng.standard_normal((n, 9)),
        tip_m=tip_m,
        tip_quaternion=np.stack([np.cos(half), np.sin(half), 0.0 * half, 0.0 * half], axis=1),
        marker_m=tip_m[:, None] * np.array([0.0, 0.5, 1.0])[:, None] + 1e-4 * rng.standard_normal((n, 3, 3)),
        payload_kg=np.full(n, 0.1),
    )
    return dataclasses.replace(log, **changes)


def simple(rows, header=HEADER):
    return header + "\n" + "".join(f"{row}\n" for row in rows)


def moving(n, start=0):
    return [f"{0.02 * k:.2f},{0.01 * k:.3f},{-0.005 * k:.3f},{-0.6 + 0.001 * k:.4f}" for k in range(start, n)]


def csv(headers, table):
    """A table as the text of a file."""
    rows = "\n".join(",".join(f"{value:.12g}" for value in row) for row in table)
    return ",".join(headers) + "\n" + rows + "\n"
