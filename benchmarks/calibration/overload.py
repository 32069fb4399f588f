"""False alarms of arms that carry exactly their largest payload."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.harness.common import arms_and_files, target
from mjx_softarm.deploy.accuracy.measure import read_goals
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.deploy.session import follow
from mjx_softarm.policy.file import load_policy


def measure(policies: tuple[str, ...], runs: int = 6, points: int = 6) -> dict[str, Any]:
    """Is an arm told to be overloaded that carries its largest payload, and no more?

    Args:
        policies: ARM=FILE of each, such as twin:0=runs/mine/policy.npz
        runs: runs of each policy; they share the goals of one circle among them
        points: goals of each run

    Raises:
        InputError: there are no policies, or one has another form.
    """
    rows = []
    for arm, file in arms_and_files(policies):
        # The arm carries its largest payload; its runs share the goals of one circle.
        controller = Controller.of(load_policy(file))
        largest_g = round(1e3 * controller.policy.spec.mass.largest_payload_kg)
        goals = read_goals("circle", controller.policy, runs * points)
        for k in range(runs):
            run = follow(open_arm(f"{arm}:{largest_g}g"), controller, goals[k::runs])
            counts, loads_kg = run.counts(), run.log.load_kg
            assert loads_kg is not None  # as the loop logs it
            rows.append(
                {
                    "arm": arm,
                    "run": k,
                    "arrivals": len(run.arrivals),
                    "highest believed [g]": 1e3 * float(np.max(loads_kg)),
                    "overloaded": counts.get(Fault.OVERLOADED, 0),
                    "load unknown": counts.get(Fault.LOAD_UNKNOWN, 0),
                }
            )
            print(rows[-1], flush=True)
    # Count the runs with a false overload.
    false, n = sum(row["overloaded"] > 0 for row in rows), len(rows)
    return {
        "targets": [target("no false overload", f"{false} of {n} runs", not false)],
        "runs": rows,
    }
