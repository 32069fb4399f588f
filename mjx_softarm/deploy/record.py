"""Record random safe poses of an arm for calibration. NumPy only: the arm need not be known yet.

The pressures are drawn as those of the poses that policies are trained on; from one set to the next goes a
ramp. A pose is logged when the springs have come to rest, or, with `transients`, every tick is. The columns
are the control loop's without references, goals and estimates.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.drive import Drive, ramp
from mjx_softarm.deploy.ending import Ending, vent_at_end
from mjx_softarm.deploy.link import Recorder
from mjx_softarm.logs.schema import Log
from mjx_softarm.spec import ArmSpec

PROGRESS_S = 10.0  # between lines of progress


class Recording(NamedTuple):
    """Results of a recording."""

    log: Log
    n_poses: int  # that came to rest
    n_unsettled: int  # that did not within SETTLE_TIMEOUT_S; not logged, transients apart
    ending: Ending


def record(
    arm: ArmIO,
    spec: ArmSpec,
    targets_kpa: np.ndarray,
    transients: bool = False,
    tell: Callable[[str], None] = lambda text: None,
    save: Callable[[Log], None] = lambda log: None,
) -> Recording:
    """Drive an arm through pressures, log it, and vent; `vent_at_end` says what else ends a recording.

    Args:
        arm: without pressure, as its driver gives it.
        spec: the arm, for its rate, its limits and the range of its sensors.
        targets_kpa (m, n) [kPa]: one set of pressures after the other.
        transients: log every tick instead of the static poses.
        tell: takes a line of progress now and then.
        save: writes the log, if it has rows, once the arm is vented.
    """
    rows, rest = Recorder(), []
    drive = Drive(arm, spec, rows.add if transients else lambda row: None)
    began_s = told_s = time.monotonic()

    def run() -> None:
        nonlocal told_s
        for k, target_kpa in enumerate(targets_kpa, 1):
            row = drive.to_rest(ramp(target_kpa, drive.dt_s))
            rest.append(row is not None)
            if row is not None and not transients:
                rows.add(row)
            now_s = time.monotonic()
            if now_s - told_s >= PROGRESS_S or k == len(targets_kpa):
                left_min = (now_s - began_s) / k * (len(targets_kpa) - k) / 60
                tell(f"{k} of {len(targets_kpa)} poses, about {left_min:.1f} min left")
                told_s = now_s

    def log() -> Log:
        return rows.log("record", drive.sensor)

    ending = vent_at_end(run, drive.link, tell, lambda: save(log()) if len(rows) else None)
    return Recording(log(), sum(rest), len(rest) - sum(rest), ending)
