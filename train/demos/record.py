"""Commands `python -m train demos record | check`: demonstrations from an arm, and the contents of a file.

An arm is recorded through its springs, pumps and motion capture alone.
The sensor-space law holds the expert's references until the arm is at rest. Then motion capture gives the
error of the finger tips, and the expert is asked for a pose that is shifted by this error. Without motion
capture the error stays unknown, and the planned pose is logged. Between moves the pumps keep their pressures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import numpy as np
import tyro

from mjx_softarm._support import cli
from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.drive import Drive, Hold
from mjx_softarm.deploy.drivers import names
from mjx_softarm.deploy.drivers.names import check_number
from mjx_softarm.deploy.ending import DONE, MISSED, NOT_WRITTEN, Ending, save_log, vent_at_end
from mjx_softarm.deploy.link import ArmFault, Recorder
from mjx_softarm.logs.files import check_file
from mjx_softarm.logs.schema import Log
from mjx_softarm.policy.lag import SETTLE_TIMEOUT_S
from mjx_softarm.sensing.pose import quaternion_from_pose, rotation_from_quaternion
from mjx_softarm.spec import ArmSpec
from train.demos.demonstrations import from_log, read_demonstrations
from train.demos.expert import Expert, ExpertError, Posture, PostureTarget
from train.demos.waypoints import TASKS, Waypoint, task
from train.options import ArmOptions, start

CLOSE_M = 1.5e-3  # error of the finger tips below which nothing is corrected
FAR_M = 0.01  # error of the finger tips above which a pose is not worth learning from
N_CORRECTIONS = 3
BEYOND_KPA = 3.0  # pressure that a chamber at its limit is assumed to lack


class RecordedPoses(NamedTuple):
    """Logged poses, with their errors."""

    log: Log
    off_m: np.ndarray  # (n,) error of the finger tips by motion capture; NaN without it
    ending: Ending


class WaypointRecorder:
    """One arm, without pressure at first, with its expert; the arm may have motion capture.

    `report` takes a line for each pose; `save` writes the log, if it has rows, once the arm is vented.
    """

    def __init__(
        self,
        arm: ArmIO,
        expert: Expert,
        report: Callable[[str], None] = lambda text: None,
        save: Callable[[Log], None] = lambda log: None,
    ):
        self.expert, self.report, self._save = expert, report, save
        self._drive = Drive(arm, expert.spec, self._tick)
        self._rows, self._off_m = Recorder(), []
        self._readings = np.empty(0)  # (n_springs,) of the newest tick

    def record(self, waypoints: Sequence[Waypoint], plan: Posture) -> RecordedPoses:
        """Bring the finger tips to waypoints as `Expert.plan` planned, log each, and vent at the end."""

        def run() -> None:
            for k, waypoint in enumerate(waypoints):
                row, off_m = self._reach(waypoint, jax.tree.map(lambda x, k=k: x[k], plan))
                self._rows.add(row | {"sequence": 0})
                self._off_m.append(off_m)
                seen = f"{1e3 * off_m:.1f} mm off" if np.isfinite(off_m) else "not seen"
                self.report(f"{len(self._rows)} of {len(waypoints)}: {waypoint.name}: {seen}")

        ending = vent_at_end(
            run, self._drive.link, self.report, lambda: self._save(self._log()) if self._rows else None
        )
        return RecordedPoses(self._log(), np.array(self._off_m), ending)

    def _log(self) -> Log:
        return self._rows.log("demonstrations", self._drive.sensor)

    def _reach(self, waypoint: Waypoint, posture: Posture) -> tuple[dict, float]:
        """Return the row at rest with the least error [m] of the finger tips, and that error."""
        target = asked = self.expert.target(waypoint)
        best, off_m, held = None, np.nan, posture
        for n_left in range(N_CORRECTIONS, -1, -1):
            # Hold the posture until rest. Where the tip is seen, move the target by its error.
            row = self._drive.to_rest(Hold(self._drive.gains, posture.spring_m, self._drive.dt_s))
            if row is not None:
                now_m, asked = self._corrected(row, target, asked)
                if best is None or now_m < off_m:
                    best, off_m, held = row, now_m, posture
                if not now_m >= CLOSE_M:  # close, or not seen
                    break
            if not n_left:
                break
            # Find another posture for the new target and the pressures that the arm had.
            asked = asked._replace(bias_kpa=self._bias_kpa(posture))
            try:
                posture = self.expert.reach(waypoint.name, asked, posture.pressure_kpa)
            except ExpertError as error:
                self.report(f"not corrected: {error}")
                break
        # Refuse a waypoint without rest, or a pose far from it.
        if best is None:
            raise self._not_at_rest(waypoint.name, posture)
        if off_m > FAR_M:
            off = f"got {1e3 * off_m:.1f} mm off after corrections, expected at most {1e3 * FAR_M:g} mm"
            raise ArmFault(f"{waypoint.name}: {off}; is the arm calibrated?")
        if not self._drive.link.sees:
            pose = held.pose.astype(float)
            best = {"tip_m": 1e-3 * pose[:3], "tip_quaternion": quaternion_from_pose(pose)} | best
        return best, off_m

    def _corrected(
        self, row: dict, target: PostureTarget, asked: PostureTarget
    ) -> tuple[float, PostureTarget]:
        """Return the error [m] of the finger tips, NaN if not seen, and the next target of the expert.

        `asked` is the target for which the expert found the present posture.
        """
        if "tip_m" not in row:
            return np.nan, asked
        rotation = rotation_from_quaternion(row["tip_quaternion"])
        finger_m = row["tip_m"] - self.expert.spec.mass.gripper_length_m * rotation[:, 2]
        return float(np.linalg.norm(finger_m - target.finger_m)), asked._replace(
            finger_m=asked.finger_m + target.finger_m - finger_m,
            rotation=target.rotation @ rotation.T @ asked.rotation,
        )

    def _bias_kpa(self, posture: Posture) -> np.ndarray:
        """Return the arm's pressures less the posture's; guessed where a limit cuts them off."""
        low, high = self._drive.gains.pressure_min_kpa, self._drive.gains.pressure_max_kpa
        kpa = self._drive.link.pressure_kpa
        beyond = np.where(kpa >= high, BEYOND_KPA, 0.0) - np.where(kpa <= low, BEYOND_KPA, 0.0)
        return kpa + beyond - posture.pressure_kpa

    def _not_at_rest(self, name: str, posture: Posture) -> ArmFault:
        off_m = self._drive.sensor.lengths(self._readings, 0.0).length_m - posture.spring_m
        worst, spec = int(np.argmax(np.abs(off_m))), self.expert.spec
        chamber = worst * (spec.n_chambers // spec.n_springs)  # beside the spring
        kpa = self._drive.link.pressure_kpa[chamber]
        return ArmFault(
            f"{name}: got no rest, expected it within {SETTLE_TIMEOUT_S:g} s; spring {worst} is "
            f"{1e3 * off_m[worst]:+.1f} mm off, its chamber at {kpa:.1f} kPa"
        )

    def _tick(self, row: dict) -> None:
        self._readings = row["readings"]


@dataclass(frozen=True, kw_only=True)
class Record(ArmOptions):
    """Bring an arm's finger tips to waypoints, and log the static poses there."""

    arm: str
    """twin:SEED, twin:SEED:pipe300, twin:SEED:500g, or package.module:Class, a driver of your own"""
    task: Annotated[str, cli.one_of(TASKS)]
    """task with its waypoints and its pipe"""
    out: Path
    """file to write, CSV or npz"""

    def __call__(self) -> int:
        console = start()
        say = console.print
        check_file("--out", self.out)
        # Plan all postures before the arm moves.
        spec, s2r, _ = self.read_arm(console)
        arm = names.open_arm(self.arm)
        check_number(arm, spec, f"--arm {self.arm}")
        waypoints, pipe = task(self.task, spec)
        expert = Expert(spec, s2r, pipe)
        plan = expert.plan(waypoints)
        # Record, and report the poses and errors.
        recorder = WaypointRecorder(arm, expert, say, partial(save_log, self.out))
        result = recorder.record(waypoints, plan)
        if len(result.log) and result.ending.status != NOT_WRITTEN:
            say(f"demonstrations: {self.out}, {len(result.log)} poses")
            if np.isfinite(result.off_m).any():
                say(f"furthest from its waypoint: {1e3 * np.nanmax(result.off_m):.1f} mm")
        if result.ending.cause:
            say(f"ended early: {result.ending.cause}")
        return result.ending.status or (DONE if len(result.log) else MISSED)


@dataclass(frozen=True, kw_only=True)
class Check(ArmOptions):
    """Print the contents of a file of demonstrations, and its faults."""

    file: tyro.conf.Positional[Path]
    """CSV or npz"""

    def __call__(self) -> int:
        console = start()
        spec = self.read_arm(console).spec
        log, findings = read_demonstrations(self.file, spec)
        for text in (*_summary(log, spec), *map(str, findings)):
            console.print(text)
        return 0


def _summary(log: Log, spec: ArmSpec) -> list[str]:
    demos = from_log(log, spec)
    ids, counts = np.unique(demos.sequence, return_counts=True)
    sequences = ", ".join(f"{k} with {count}" for k, count in zip(ids, counts, strict=True))
    low, high = demos.positions.min(axis=0), demos.positions.max(axis=0)
    ranges = ", ".join(f"{axis} {low[k]:.0f} to {high[k]:.0f}" for k, axis in enumerate("xyz"))
    return [
        f"poses: {len(log)}, tip [mm]: {ranges}",
        f"sequences: {len(ids)}: {sequences}",
        f"actions: {demos.actions.min():.3f} to {demos.actions.max():.3f} of -1 to 1",
    ]
