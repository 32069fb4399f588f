"""Record static poses of an arm for calibration. NumPy only; the arm need not be calibrated.

A ramp leads from one set of pressures to the next. Each set is held until the arm is at rest by calibration's
rule (`mjx_softarm.logs.rest`). A pose is logged as the mean over the last second of its hold; with
`transients`, each tick is logged. The columns are those of the control loop's log without references, goals
and estimates.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.belief import LOST_SHARE, STUCK_PRESSURE_KPA, stuck_springs
from mjx_softarm.deploy.drive import Drive, ramp
from mjx_softarm.deploy.ending import Ending, vent_at_end
from mjx_softarm.deploy.link import ArmFault, Recorder, stacked
from mjx_softarm.logs.checks import same_sign
from mjx_softarm.logs.rest import MIN_HOLD_S, NEEDED, ROUNDING_S, WINDOW_S, leaves, moves
from mjx_softarm.logs.schema import Log
from mjx_softarm.policy.lag import SETTLE_TIMEOUT_S
from mjx_softarm.spec import ArmSpec

TIMEOUT_S = SETTLE_TIMEOUT_S + MIN_HOLD_S + WINDOW_S
PROGRESS_S = 10.0  # between lines of progress
UNSEEN_POSES = 3  # poses in a row without a frame of motion capture after which it counts as gone; by hand


class PoseRecording(NamedTuple):
    """Results of a recording."""

    log: Log
    n_poses: int  # number of poses at rest
    n_unsettled: int  # number of poses not seen at rest within TIMEOUT_S; logged only with transients
    ending: Ending


def record(
    arm: ArmIO,
    spec: ArmSpec,
    targets_kpa: np.ndarray,
    transients: bool = False,
    tell: Callable[[str], None] = lambda text: None,
    save: Callable[[Log], None] = lambda log: None,
) -> PoseRecording:
    """Drive an arm through pressures, log it, and vent; `vent_at_end` says what else ends a recording.

    Args:
        arm: without pressure, as its driver gives it.
        spec: the arm, for its rate, its limits and the range of its sensors.
        targets_kpa (m, n_chambers) [kPa]: sets of pressures, in order.
        transients: log every tick instead of the static poses.
        tell: takes lines of progress.
        save: writes the log, if it has rows, once the arm is vented.
    """
    rows = Recorder()
    hold = _Hold()
    rest = []

    def on_tick(row: dict) -> None:
        hold.add(row, "tip_m" in row or not drive.link.sees)
        if transients:
            rows.add(row)

    drive = Drive(arm, spec, on_tick)
    began_s = reported_s = time.monotonic()

    def run() -> None:
        nonlocal reported_s
        for k, target_kpa in enumerate(targets_kpa, 1):
            # Drive to the pressures, check the arm, log the pose.
            hold.ticks.clear()
            rest.append(drive.to_rest(ramp(target_kpa, drive.dt_s), hold.is_long, TIMEOUT_S) is not None)
            hold.check(drive, target_kpa if rest[-1] else None)
            if rest[-1] and not transients:
                rows.add(_mean(hold.last_second()))

            # Report the progress.
            now_s = time.monotonic()
            if now_s - reported_s >= PROGRESS_S or k == len(targets_kpa):
                left_min = (now_s - began_s) / k * (len(targets_kpa) - k) / 60
                tell(f"{k} of {len(targets_kpa)} poses, about {left_min:.1f} min left")
                reported_s = now_s

    def log() -> Log:
        return rows.log("record", drive.sensor)

    ending = vent_at_end(run, drive.link, tell, lambda: save(log()) if len(rows) else None)
    return PoseRecording(log(), sum(rest), len(rest) - sum(rest), ending)


class _Hold:
    """Rows at one set of pressures, cut as calibration cuts holds out of a log of all ticks."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self.ticks: list[dict[str, Any]] = []  # all rows of this pose, the ramp's too
        self._n_unseen = 0  # poses in a row without a frame of motion capture

    def add(self, row: dict[str, Any], seen: bool) -> None:
        """Take the row of a tick; `seen` is False where motion capture missed the tip."""
        self.ticks.append(row)
        if not seen or not all(np.isfinite(row[name]).all() for name in NEEDED if name in row):
            return  # calibration leaves out such rows, too
        if self.rows and leaves(row["pressure_kpa"], self.rows[0]["pressure_kpa"]):
            self.rows.clear()
        self.rows.append(row)

    def last_second(self) -> list[dict[str, Any]]:
        """Return the rows of the last second."""
        since_s = self.rows[-1]["time_s"] - WINDOW_S - ROUNDING_S
        return [row for row in self.rows if row["time_s"] >= since_s]

    def is_long(self) -> bool:
        """Return whether the hold has been long enough and the tip is at rest."""
        held_s = self.rows[-1]["time_s"] - self.rows[0]["time_s"] if self.rows else 0.0
        if held_s < MIN_HOLD_S + WINDOW_S - ROUNDING_S:
            return False
        rows = self.last_second()
        if "tip_m" not in rows[0]:
            return True
        return not moves(*(np.array([row[name] for row in rows]) for name in ("time_s", "tip_m")))

    def check(self, drive: Drive, target_kpa: np.ndarray | None) -> None:
        """Check sensors and chambers by the rows of a pose.

        Raises:
            ArmFault: a sensor stood stock-still, a chamber at rest lacks its pressure, or motion capture is
                gone.
        """
        # Motion capture
        unseen = drive.link.sees and not any("tip_m" in row for row in self.ticks)
        self._n_unseen = self._n_unseen + 1 if unseen else 0
        if self._n_unseen >= UNSEEN_POSES:
            raise ArmFault(f"motion_capture: got no frame in {UNSEEN_POSES} poses, expected the tip in each")

        # Sensors and chambers
        kpa = np.array([row["pressure_kpa"] for row in self.ticks])
        readings = np.array([row["readings"] for row in self.ticks])
        spring_m = drive.sensor.lengths(readings, np.nan).length_m
        stuck = np.flatnonzero(stuck_springs(spring_m, kpa, drive.spec.structure.n_sections))
        if stuck.size:
            raise ArmFault(f"spring{stuck[0]}: got the same reading always, expected one that changes")
        if target_kpa is None:
            return
        least_kpa = np.maximum(STUCK_PRESSURE_KPA, LOST_SHARE * np.abs(target_kpa))
        off = np.abs(kpa[-1] - target_kpa) > least_kpa
        if (k := np.flatnonzero(off)).size:
            got = kpa[-1, k[0]]
            wanted = target_kpa[k[0]]
            raise ArmFault(f"pressures: chamber{k[0]}: got {got:.1f} kPa at rest, expected {wanted:.1f} kPa")


def _mean(rows: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Return the mean of rows at rest over their finite numbers; NaN where there is none."""
    values = stacked(rows)
    if "tip_quaternion" in values:
        mean = same_sign(values["tip_quaternion"])[0].mean(axis=0)
        values["tip_quaternion"] = mean[None] / np.linalg.norm(mean)
    with np.errstate(invalid="ignore"):  # 0 / 0 is NaN
        return {
            name: np.where(np.isfinite(value), value, 0.0).sum(axis=0) / np.isfinite(value).sum(axis=0)
            for name, value in values.items()
        }
