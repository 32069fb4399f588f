"""Record an arm for calibration: poses at rest, and its motion between them. NumPy only; any arm.

A step and a ramp lead from one set of pressures to the next; the step shows how fast the actuators follow.
Each set is held until the arm is at rest by calibration's rule (`mjx_softarm.logs.rest`).

From time to time each tip of the second half is predicted from the springs, by a Gaussian process of what
sections that bend evenly leave: from all other poses, and from the first half alone. Once all others predict
no better, more poses bring nothing, and the recording ends.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.belief import LOST_SHARE, STUCK_PRESSURE_KPA, stuck_springs
from mjx_softarm.deploy.drive import Drive, ramp
from mjx_softarm.deploy.ending import Ending, vent_at_end
from mjx_softarm.deploy.link import ArmFault, Recorder
from mjx_softarm.logs.rest import MIN_HOLD_S, NEEDED, ROUNDING_S, WINDOW_S, leaves, moves
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.body import holes_m, spring_directions
from mjx_softarm.policy.lag import SETTLE_TIMEOUT_S
from mjx_softarm.posture import base_rotation
from mjx_softarm.sensing.estimator import Frame, even_pose
from mjx_softarm.spec import ArmSpec

TIMEOUT_S = SETTLE_TIMEOUT_S + MIN_HOLD_S + WINDOW_S
PROGRESS_S = 10.0  # between lines of progress
UNSEEN_POSES = 3  # poses in a row without a frame of motion capture after which it counts as gone; by hand
# First step of the command towards a pose, in ranges of pressure: ten times a regulator's deadband, and too
# small to swing the arm; by hand
STEP_SHARE = 1 / 6
MIN_POSES = 40  # least number of poses of a recording that ends by itself
# Greatest number: no pressure is written meanwhile. 200 poses take 15 ms, 500 would take 170 ms, and ten
# times as long on a small computer, whose silence of 1 s makes the firmware vent.
MOST_POSES = 200
CHECK_POSES = 10  # poses between two checks whether more bring something; two in a row have to agree
ENOUGH = 0.95  # ratio of the errors by all poses and by half of them from which more poses bring nothing
# What recordings of the paper's arm brought; docs/results/arms-minutes.json
ACCURACY = (
    "for comparison, the paper's arm, simulated: "
    "its circle at 0.4 to 1.2 mm after 60 poses, at 0.4 to 0.7 after 150"
)
LENGTHS = np.geomspace(1.0, 30.0, 6)  # length scales that are tried, in deviations of the springs
NOISE = 0.05  # deviation of a tip's noise, in that of the process


class PoseRecording(NamedTuple):
    """Results of a recording."""

    log: Log
    n_poses: int  # number of poses at rest
    n_unsettled: int  # number of poses not seen at rest within TIMEOUT_S
    ending: Ending


def record(
    arm: ArmIO,
    spec: ArmSpec,
    targets_kpa: np.ndarray,
    tell: Callable[[str], None] = lambda text: None,
    save: Callable[[Log], None] = lambda log: None,
) -> PoseRecording:
    """Drive an arm through pressures, log every tick, and vent; `vent_at_end` has what else ends a recording.

    Args:
        arm: without pressure, as its driver gives it.
        spec: of the arm.
        targets_kpa (m, n_chambers) [kPa]: sets of pressures, in order.
        tell: takes lines of progress.
        save: writes the log, if it has rows, once the arm is vented.
    """
    rows = Recorder()
    rest = []  # whether each pose was seen at rest
    poses = []  # spring lengths and tip [m] of each pose with both

    def on_tick(row: dict) -> None:
        hold.add(row)
        rows.add(row)

    drive = Drive(arm, spec, on_tick)
    hold = _Hold(drive)
    step_kpa = STEP_SHARE * (spec.chambers.pressure_max_kpa - spec.chambers.pressure_min_kpa)

    def run() -> None:
        began_s = reported_s = time.monotonic()
        error_mm = np.nan
        n_enough = 0
        for k, target_kpa in enumerate(targets_kpa, 1):
            # Drive to the pressures, and check the arm.
            hold.ticks.clear()
            law = ramp(target_kpa, drive.dt_s, step_kpa)
            rest.append(drive.to_rest(law, hold.is_long, TIMEOUT_S) is not None)
            hold.check(target_kpa if rest[-1] else None)

            # Predict each tip from the other poses; end where more poses bring nothing.
            if rest[-1] and np.isfinite(pose := hold.pose()).all():
                poses.append(pose)
                if MIN_POSES <= len(poses) <= MOST_POSES and len(poses) % CHECK_POSES == 0:
                    half_mm, error_mm = prediction_errors_mm(np.array(poses), spec)
                    n_enough = n_enough + 1 if error_mm > ENOUGH * half_mm else 0

            # Report the progress.
            now_s = time.monotonic()
            if n_enough > 1 or now_s - reported_s >= PROGRESS_S or k == len(targets_kpa):
                left_min = (now_s - began_s) / k * (len(targets_kpa) - k) / 60
                line = f"{k} of {len(targets_kpa)} poses, about {left_min:.1f} min left"
                known = f"; each is predicted from the others to {error_mm:.1f} mm"
                tell(line if np.isnan(error_mm) else line + known)
                reported_s = now_s
            if n_enough > 1:
                tell("half of them predict as well: more poses bring nothing")
                return

    def log() -> Log:
        return rows.log("record", drive.sensor)

    ending = vent_at_end(run, drive.link, tell, lambda: save(log()) if len(rows) else None)
    return PoseRecording(log(), sum(rest), len(rest) - sum(rest), ending)


def prediction_errors_mm(poses: np.ndarray, spec: ArmSpec) -> tuple[float, float]:
    """Return median errors [mm] of the second half's tips: predicted by the first half, and by all others.

    Args:
        poses (n, n_springs + 3) [m]: spring lengths and tips.
        spec: the arm.

    Source: Rasmussen, Williams, "Gaussian Processes for Machine Learning" (2006), section 5.4.2.
    """
    # What even bending leaves, and similarity of the poses
    spring_m, tip_m = poses[:, : spec.n_springs], poses[:, spec.n_springs :]
    base = Frame(np.array(spec.mounting.base_offset_m), base_rotation(spec))
    site_m = holes_m(spring_directions(spec), spec.per_section(spec.geometry.spring_radius_m))
    left_mm = 1e3 * tip_m - even_pose(base, site_m, spring_m)[:, :3]
    left_mm -= left_mm.mean(axis=0)
    spring = (spring_m - spring_m.mean(axis=0)) / np.maximum(spring_m.std(axis=0), 1e-6)
    square = np.sum((spring[:, None] - spring) ** 2, axis=-1)

    # Errors of each length scale; the best one counts
    n = len(poses) // 2
    errors = []
    for length in LENGTHS:
        kernel = 1.0 + spring @ spring.T + np.exp(-0.5 * square / length**2) + NOISE**2 * np.eye(len(poses))
        inverse = np.linalg.inv(kernel)
        by_half = left_mm[n:] - kernel[n:, :n] @ np.linalg.solve(kernel[:n, :n], left_mm[:n])
        by_others = (inverse @ left_mm)[n:] / inverse.diagonal()[n:, None]
        errors.append([np.median(np.linalg.norm(error, axis=1)) for error in (by_half, by_others)])
    by_half_mm, by_others_mm = np.min(errors, axis=0)
    return float(by_half_mm), float(by_others_mm)


class _Hold:
    """Rows at one set of pressures, cut as calibration cuts holds out of a log of all ticks."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self.rows: list[dict[str, Any]] = []
        self.ticks: list[dict[str, Any]] = []  # all rows of this pose, the ramp's too
        self._n_unseen = 0  # poses in a row without a frame of motion capture

    def add(self, row: dict[str, Any]) -> None:
        """Take the row of a tick."""
        self.ticks.append(row)
        seen = "tip_m" in row or not self._drive.link.sees
        if not seen or not all(np.isfinite(row[name]).all() for name in NEEDED if name in row):
            return  # calibration leaves out such rows, too
        if self.rows and leaves(row["pressure_kpa"], self.rows[0]["pressure_kpa"]):
            self.rows.clear()
        self.rows.append(row)

    def last_second(self) -> list[dict[str, Any]]:
        since_s = self.rows[-1]["time_s"] - WINDOW_S - ROUNDING_S
        return [row for row in self.rows if row["time_s"] >= since_s]

    def spring_m(self, rows: list[dict[str, Any]]) -> np.ndarray:
        """Return the lengths (k, n_springs) [m] of rows, NaN where a reading was lost."""
        readings = np.array([row["readings"] for row in rows])
        return self._drive.sensor.lengths(readings, np.nan).length_m

    def pose(self) -> np.ndarray:
        """Return spring lengths and tip (n_springs + 3,) [m] at the end of a hold; NaN where unknown."""
        rows = self.last_second()
        tip_m = np.array([row.get("tip_m", np.full(3, np.nan)) for row in rows])
        return np.append(self.spring_m(rows).mean(axis=0), tip_m.mean(axis=0))

    def is_long(self) -> bool:
        """Return whether the hold has been long enough and the tip is at rest."""
        held_s = self.rows[-1]["time_s"] - self.rows[0]["time_s"] if self.rows else 0.0
        if held_s < MIN_HOLD_S + WINDOW_S - ROUNDING_S:
            return False
        rows = self.last_second()
        if "tip_m" not in rows[0]:
            return True
        return not moves(*(np.array([row[name] for row in rows]) for name in ("time_s", "tip_m")))

    def check(self, target_kpa: np.ndarray | None) -> None:
        """Check sensors and chambers by the rows of a pose; its pressures if it was seen at rest.

        Raises:
            ArmFault: a sensor stood stock-still, a chamber at rest lacks its pressure, or motion capture is
                gone.
        """
        # Motion capture
        unseen = self._drive.link.sees and not any("tip_m" in row for row in self.ticks)
        self._n_unseen = self._n_unseen + 1 if unseen else 0
        if self._n_unseen >= UNSEEN_POSES:
            raise ArmFault(f"motion_capture: got no frame in {UNSEEN_POSES} poses, expected the tip in each")

        # Sensors and chambers
        kpa = np.array([row["pressure_kpa"] for row in self.ticks])
        n_sections = self._drive.spec.structure.n_sections
        stuck = np.flatnonzero(stuck_springs(self.spring_m(self.ticks), kpa, n_sections))
        if stuck.size:
            raise ArmFault(f"spring{stuck[0]}: got the same reading always, expected one that changes")
        if target_kpa is None:
            return
        least_kpa = np.maximum(STUCK_PRESSURE_KPA, LOST_SHARE * np.abs(target_kpa))
        off = np.flatnonzero(np.abs(kpa[-1] - target_kpa) > least_kpa)
        if off.size:
            k = off[0]
            text = f"got {kpa[-1, k]:.1f} kPa at rest, expected {target_kpa[k]:.1f} kPa"
            raise ArmFault(f"pressures: chamber{k}: {text}")
