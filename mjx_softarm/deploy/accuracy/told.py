"""Lines for the terminal on a run and on its accuracy."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjx_softarm.deploy.ending import LoopRun
from mjx_softarm.policy.file import Policy


def tell_run(run: LoopRun, policy: Policy) -> None:
    """Print faults, times and reached goals of a run, and the reason for a missed goal."""
    for fault, count in run.counts().items():
        print(f"fault: {fault.value}: {count} times, {fault.response.value}")
    if len(run.latency_s):
        median, high = 1e3 * np.quantile(run.latency_s, (0.5, 0.999))
        n = len(run.latency_s)
        print(f"from readings to pressures: median {median:.2f} ms, 99.9 % {high:.2f} ms of {n} ticks")
    reached = f"{sum(arrival.reached for arrival in run.arrivals)} of {run.n_goals} goals reached"
    print(f"{reached}; the arm is {'' if run.ending.vented else 'NOT '}vented")

    # The error that a goal allows, and a reason for more
    if all(arrival.reached for arrival in run.arrivals):
        return
    reward = policy.reward
    for largest, unit, other in (
        (max(reward.weights[:3]), "mm", "rotation"),
        (max(reward.weights[3:]), "deg", "position"),
    ):
        if largest:
            within = f"{reward.threshold / largest:.2g} {unit}"
            print(f"a goal counts as reached within {within} if the {other} is exact")
    if not policy.calibrated:
        print(
            "the policy is not calibrated: it is expected to miss on an arm that differs from its "
            "specification; record a log, run `python -m calib run`, train and export (docs/your-arm.md)"
        )


def tell_accuracy(found: dict[str, Any]) -> None:
    """Print the figures of an accuracy."""
    for name, unit, most in (("translation", "mm", "max_mm"), ("rotation", "deg", "rotation_max_deg")):
        mean, high, most = found[f"{name}_{unit}"], found[f"{name}_95_{unit}"], found[most]
        if np.isnan(mean):  # goals do not ask for it
            continue
        print(f"{name} [{unit}]: mean {mean:.2f}, 95 % below {high:.2f}, at most {most:.2f}")
    if "way_s" in found:
        print(
            f"on the way, {found['way_s']:.0f} s [mm]: mean {found['way_mm']:.2f}, 95 % below "
            f"{found['way_95_mm']:.2f}, at most {found['way_max_mm']:.2f}; {found['lag_s']:.2f} s behind, "
            f"without that {found['way_without_lag_mm']:.2f}"
        )
    n_saturated = found["saturated_points"]
    print(f"{found['measured']} of {found['points']} goals measured, {n_saturated} with a saturated chamber")
