"""Demonstrations recorded on an arm, through its springs, pumps and motion capture alone.

The sensor-space law holds the expert's references until the arm is at rest. Then motion capture gives the
error of the finger tips, and the target is shifted by it, away from the limits of chambers.
Without motion capture the error stays unknown, and the planned pose is logged. Alternatively keys steer the
finger tips in steps, and the same expert finds the references. Between moves the pumps keep their pressures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, TextIO

import jax
import numpy as np

from mjx_softarm.deploy.drive import Drive, Hold
from mjx_softarm.deploy.ending import Ending, vent_at_end
from mjx_softarm.deploy.faults import SETTLE_TIMEOUT_S
from mjx_softarm.deploy.link import ArmFault, Recorder
from mjx_softarm.logs.schema import Log
from mjx_softarm.sensing.pose import quaternion_from_pose, rotation_from_quaternion
from train.demos.expert import Expert, ExpertError, Posture
from train.demos.waypoints import Waypoint

CLOSE_M = 1.5e-3  # error of the finger tips below which nothing is corrected
FAR_M = 0.01  # error of the finger tips above which a pose is not worth learning from
N_CORRECTIONS = 3
BEYOND_KPA = 3.0  # pressure that a chamber at its limit is assumed to lack
STEPS_M = {"s": 0.005, "l": 0.02}
AXES = dict(zip("xyz", np.eye(3), strict=True))
KEYS = "x y z, X Y Z: a step forth, back; s, l: steps of 5, 20 mm; space: log; q: end"


class Recording(NamedTuple):
    """Logged poses, with their errors."""

    log: Log
    off_m: np.ndarray  # (n,) error of the finger tips by motion capture; NaN without it
    ending: Ending


class Teleoperation:
    """One arm, without pressure at first, with its expert.

    Args:
        arm: an `ArmIO`, maybe with motion capture.
        expert: expert for the arm.
        tell: takes a line for each pose.
        save: writes the log, if it has rows, once the arm is vented.
    """

    def __init__(
        self,
        arm: Any,
        expert: Expert,
        tell: Callable[[str], None] = lambda text: None,
        save: Callable[[Log], None] = lambda log: None,
    ):
        self.expert, self.tell, self._save = expert, tell, save
        self._sees = hasattr(arm, "motion_capture")
        self._drive = Drive(arm, expert.spec, self._look)
        self._rows, self._off_m, self._last = Recorder(), [], {}
        start = expert.look(np.zeros((1, expert.spec.n_chambers)))
        self._now: Posture = jax.tree.map(lambda x: x[0], start)

    def record(self, waypoints: Sequence[Waypoint], plan: Posture, sequence: int = 0) -> Recording:
        """Bring the finger tips to waypoints, log each, and vent; `vent_at_end` says what else ends it.

        Args:
            waypoints: one after the other.
            plan: postures (n,) at the waypoints, by `Expert.plan`.
            sequence: id of the demonstration.
        """

        def run() -> None:
            for k, waypoint in enumerate(waypoints):
                row, off_m = self._reach(waypoint, jax.tree.map(lambda x, k=k: x[k], plan))
                self._add(row, sequence, off_m)
                seen = f"{1e3 * off_m:.1f} mm off" if np.isfinite(off_m) else "not seen"
                self.tell(f"{len(self._rows)} of {len(waypoints)}: {waypoint.name}: {seen}")

        return self._end(run)

    def steer(self, keys: Iterable[str], sequence: int = 0) -> Recording:
        """Move by keys until the keys end; see `KEYS`."""

        def run() -> None:
            step_m, logged = STEPS_M["l"], True
            finger_m = self._now.finger_m
            for key in keys:
                if key == "q":
                    return
                if key in STEPS_M:
                    step_m = STEPS_M[key]
                elif key.lower() in AXES:
                    goal_m = finger_m + (step_m if key.islower() else -step_m) * AXES[key.lower()]
                    if self._step(goal_m):
                        finger_m, logged = goal_m, False
                elif key == " " and logged:
                    self.tell("not moved since the start, or since the last pose was logged")
                elif key == " ":
                    logged = True
                    self._add(self._last, sequence, np.nan)
                    self.tell(f"pose {len(self._rows)} logged")
                elif key.strip():
                    self.tell(f"got key {key!r}; {KEYS}")

        return self._end(run)

    def _end(self, run: Callable[[], None]) -> Recording:
        ending = vent_at_end(
            run, self._drive.link, self.tell, lambda: self._save(self._log()) if self._rows else None
        )
        return Recording(self._log(), np.array(self._off_m), ending)

    def _log(self) -> Log:
        return self._rows.log("demonstrations", self._drive.sensor)

    def _reach(self, waypoint: Waypoint, posture: Posture) -> tuple[dict, float]:
        """Return the row at rest and the error [m] of the finger tips, after at most `N_CORRECTIONS`."""
        target = asked = self.expert.target(waypoint)
        row, off_m = None, np.nan
        for n_left in range(N_CORRECTIONS, -1, -1):
            row = self._hold(posture)
            if row is not None:
                finger_m, rotation = self._seen(row)
                seen = "tip_m" in row
                off_m = float(np.linalg.norm(finger_m - target.finger_m)) if seen else np.nan
                if not seen or off_m < CLOSE_M:
                    break
                asked = asked._replace(
                    finger_m=asked.finger_m + target.finger_m - finger_m,
                    rotation=target.rotation @ rotation.T @ asked.rotation,
                )
            if not n_left:
                break
            asked = asked._replace(bias_kpa=self._bias_kpa(posture))
            try:
                posture = self.expert.reach(waypoint.name, asked, posture.pressure_kpa)
            except ExpertError as error:
                self.tell(f"not corrected: {error}")
                break
        if row is None:
            raise self._not_at_rest(waypoint.name)
        if off_m > FAR_M:
            off = f"got {1e3 * off_m:.1f} mm off after corrections, expected at most {1e3 * FAR_M:g} mm"
            raise ArmFault(f"{waypoint.name}: {off}; is the arm calibrated?")
        return row, off_m

    def _step(self, finger_m: np.ndarray) -> bool:
        """Bring the finger tips to a point (3,) [m]; False, with a message, where that cannot be done."""
        waypoint = Waypoint("keyboard", finger_m)
        try:
            posture = self.expert.reach(waypoint.name, self.expert.target(waypoint), self._now.pressure_kpa)
        except ExpertError as error:
            self.tell(str(error))
            return False
        row = self._hold(posture)
        if row is None:
            raise self._not_at_rest(waypoint.name)
        self.tell(f"finger tips at {', '.join(f'{1e3 * value:.0f}' for value in self._seen(row)[0])} mm")
        return True

    def _hold(self, posture: Posture) -> dict | None:
        """Hold a posture's references; return the row at rest, or None."""
        self._now = posture
        return self._drive.to_rest(Hold(self._drive.gains, posture.spring_m, self._drive.dt_s))

    def _bias_kpa(self, posture: Posture) -> np.ndarray:
        """Return the arm's pressures less the posture's; guessed where a limit cuts them off."""
        low, high = self._drive.gains.pressure_min_kpa, self._drive.gains.pressure_max_kpa
        kpa = self._drive.link.pressure_kpa
        beyond = np.where(kpa >= high, BEYOND_KPA, 0.0) - np.where(kpa <= low, BEYOND_KPA, 0.0)
        return kpa + beyond - posture.pressure_kpa

    def _not_at_rest(self, name: str) -> ArmFault:
        readings = self._last["readings"]
        off_m = self._drive.sensor.lengths(readings, 0.0).length_m - self._now.spring_m
        worst = int(np.argmax(np.abs(off_m)))
        return ArmFault(
            f"{name}: got no rest, expected it within {SETTLE_TIMEOUT_S:g} s; spring {worst} is "
            f"{1e3 * off_m[worst]:+.1f} mm off, its chamber at {self._drive.link.pressure_kpa[worst]:.1f} kPa"
        )

    def _look(self, row: dict) -> None:
        self._last = row

    def _seen(self, row: dict) -> tuple[np.ndarray, np.ndarray]:
        """Return finger tips (3,) [m] and rotation (3, 3) of the gripper, measured if there is a frame."""
        if "tip_m" not in row:
            return self._now.finger_m, self._now.rotation
        rotation = rotation_from_quaternion(row["tip_quaternion"])
        return row["tip_m"] - self.expert.spec.mass.gripper_length_m * rotation[:, 2], rotation

    def _add(self, row: dict, sequence: int, off_m: float) -> None:
        if not self._sees:
            pose = self._now.pose.astype(float)
            row = {"tip_m": 1e-3 * pose[:3], "tip_quaternion": quaternion_from_pose(pose)} | row
        self._rows.add(row | {"sequence": sequence})
        self._off_m.append(off_m)


def read_keys(stream: TextIO) -> Iterator[str]:
    """Yield characters as they are typed; on a terminal without waiting for the end of the line."""
    if not stream.isatty():
        yield from iter(lambda: stream.read(1), "")
        return
    import termios
    import tty

    before = termios.tcgetattr(stream)
    try:
        tty.setcbreak(stream)
        yield from iter(lambda: stream.read(1), "")
    finally:
        termios.tcsetattr(stream, termios.TCSADRAIN, before)
