"""Random safe poses of an arm, logged for calibration. NumPy only: the arm need not be known yet.

The pressures are drawn as those of the poses that policies are trained on; from one set to the next goes a
ramp. A pose is logged when the springs have come to rest, or, with `transients`, every tick is. The columns
are the control loop's without references, goals and estimates.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.drive import Drive, drive_to_end, ramp
from mjx_softarm.deploy.session import Recorder
from mjx_softarm.logs.schema import Log
from mjx_softarm.spec import ArmSpec


class Recording(NamedTuple):
    """What was logged."""

    log: Log
    n_poses: int  # that came to rest
    n_unsettled: int  # that did not within SETTLE_TIMEOUT_S; not logged, transients apart
    problem: str  # why it ended early, or ""


def record(
    arm: ArmIO,
    spec: ArmSpec,
    targets_kpa: np.ndarray,
    transients: bool = False,
    tell: Callable[[str], None] = lambda text: None,
) -> Recording:
    """Drive an arm through pressures, log it, and vent; Ctrl-C vents and keeps the log.

    Args:
        arm: without pressure, as its driver gives it.
        spec: the arm, for its rate, its limits and the range of its sensors.
        targets_kpa (m, n) [kPa]: one set of pressures after the other.
        transients: log every tick instead of the poses at rest.
        tell: takes a line now and then.
    """
    rows, rest = Recorder(arm), []
    drive = Drive(arm, spec, rows.add if transients else lambda row: None)

    def run() -> None:
        for k, target_kpa in enumerate(targets_kpa):
            row = drive.to_rest(ramp(target_kpa, drive.dt_s))
            rest.append(row is not None)
            if row is not None and not transients:
                rows.add(row)
            if (k + 1) % max(1, len(targets_kpa) // 10) == 0:
                tell(f"{k + 1} of {len(targets_kpa)} poses")

    problem = drive_to_end(drive, run)
    return Recording(rows.log("record", spec.sensor), sum(rest), len(rest) - sum(rest), problem)
