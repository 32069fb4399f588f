"""Command line: `python -m mjx_softarm.deploy run | measure | record`.

However a command ends, the arm is vented and what was logged is written.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.budget import budget, draw
from mjx_softarm.deploy.capture import CapturedArm, with_capture
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.drivers.names import check_arm, check_number, open_arm, twin_spec
from mjx_softarm.deploy.ending import MISSED, save_log
from mjx_softarm.deploy.link import first_frame
from mjx_softarm.deploy.measure import (
    along,
    figures,
    measure,
    print_figures,
    print_origin,
    print_run,
    read_goals,
    ways_of,
    whole_goal,
    write_accuracy,
)
from mjx_softarm.deploy.record import ACCURACY, record
from mjx_softarm.deploy.session import LoopRun, follow, trace
from mjx_softarm.logs.files import check_file
from mjx_softarm.logs.schema import Log
from mjx_softarm.logs.wiring import wiring_faults
from mjx_softarm.mechanics.excitation import growing, random_pressures
from mjx_softarm.policy.file import SHIPPED, load_policy
from mjx_softarm.spec import ArmSpec

_STATUS = """Exit status: 0 done; 1 done, but a goal was not reached, or was refused, or no pose was logged;
2 it could not begin, or its log could not be written; 3 a fault ended it; 130 Ctrl-C; 143 SIGTERM. In all
cases the arm is vented and what was logged is written."""
_ABOUT = f"A policy on an arm.\n\n{_STATUS}"


def _goal(words: list[str]) -> tuple[float, ...]:
    goal = tuple(map(float, words[0].split(",")))
    if len(goal) not in (3, 6):
        raise ValueError(f"got {len(goal)} numbers, expected x,y,z,yaw,pitch,roll, or x,y,z alone")
    return goal


Goal = Annotated[tuple[float, ...], cli.listed(_goal, "X,Y,Z,YAW,PITCH,ROLL")]
PolicyFile = Annotated[
    Path,
    tyro.conf.arg(
        help="file that `python -m train export` wrote",
        help_behavior_hint="(default: the package's own, for the paper's arm)",
    ),
]
Arm = Annotated[
    str,
    tyro.conf.arg(
        help="yours: package.module:Class, or a file of hardware, wiring.toml; simulated: twin:SEED, or "
        "twin:rod:SEED; twin:SEED@ARM.toml, of another arm; twin:SEED:pipe300, in a pipe; "
        "twin:SEED:aged, later; twin:SEED:exact, as specified; twin:SEED:lost4, with chamber 4 burst; "
        "twin:SEED:500g, with a payload"
    ),
]


@dataclass(frozen=True)
class DriverOptions:
    """Options of a command that drives an arm: the arm, and motion capture beside its driver."""

    arm: Arm
    capture: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="SYSTEM:HOST:BODY",
            help="natnet:HOST:BODY or qualisys:HOST:BODY, for an arm whose driver has no motion capture; "
            "options: ,base=BODY,markers=NAME,up=y|z",
        ),
    ] = None

    def open(self, spec: ArmSpec) -> Any:
        """Open the driver of an arm with this specification, and its motion capture."""
        driver = open_arm(self.arm)
        if self.arm.startswith("twin:") and ArmSpec.of(twin_spec(self.arm)).geometry != spec.geometry:
            remedy = "give the other arm's policy, or the twin of this arm, twin:SEED@ARM.toml"
            tell(f"{self.arm} is a twin of another arm than {spec.name!r}: {remedy}")
        return with_capture(driver, self.capture, spec, tell)


Arms = Annotated[DriverOptions, tyro.conf.arg(name="")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    commands = {"run": _run, "measure": _measure, "record": _record}
    return cli.main("python -m mjx_softarm.deploy", _ABOUT, commands, arguments)


def _run(
    options: Arms,
    goal: tyro.conf.UseAppendAction[tuple[Goal, ...]],
    policy: tyro.conf.Positional[PolicyFile] = SHIPPED,
    log: cli.MaybePath = None,
    duration: float = np.inf,
    stay: bool = False,
) -> int:
    """Bring the tip to goals; errors are by motion capture if the arm has it.

    Args:
        goal: pose of the tip [mm, deg] in the base frame, or X,Y,Z for a policy of positions; give the option
            again for a further one
        log: file for the run's log; its suffix chooses CSV or npz
        duration: [s] of the arm after which the run ends
        stay: hold the last goal, until Ctrl-C or the end of the duration
    """
    if not goal:
        raise InputError("--goal: got nothing, expected the pose of the tip, X,Y,Z,YAW,PITCH,ROLL")
    if not duration > 0.0:
        raise InputError(f"--duration: got {duration:g}, expected a number > 0")
    controller = _controller(policy)
    goals = [whole_goal(one, controller.policy, "--goal") for one in goal]
    check_file("--log", log)
    driver = options.open(controller.policy.spec)
    check_arm(driver, controller, f"--arm {options.arm}")

    save = partial(save_log, log) if log else lambda log: None
    run = follow(driver, controller, goals, duration, tell, save=save, stay=stay)
    if log and len(run.log) and run.ending.status != cli.ERROR:
        print(f"log: {log}, {len(run.log)} rows")
    finish(driver)
    print_run(run, controller.policy)
    return run.status


def _controller(policy: Path) -> Controller:
    if policy == SHIPPED:
        tell("policy: the package's own, for the paper's arm as specified; for an arm of yours train one")
    return Controller.of(load_policy(policy))


def _measure(
    options: Arms,
    out: Path,
    policy: tyro.conf.Positional[PolicyFile] = SHIPPED,
    goals: Annotated[str, tyro.conf.arg(metavar="circle|grid|FILE")] = "circle",
    points: int = 16,
    seconds: float | None = None,
    payload: float | None = None,
) -> int:
    """Measure a policy's accuracy on an arm with motion capture, and say what makes the error.

    Args:
        out: folder to write: the figures, pictures, the log
        goals: circle; grid, over the workspace; or a CSV file of poses
        points: of the circle, or of the grid at most
        seconds: pass all goals without a stop in so long [s], from the first to the last
        payload: mass that hangs at the gripper, which the loop is not given; a simulated arm gets it [g];
            None: the loop's estimate counts
    """
    if payload is not None and not 0.0 <= payload < np.inf:
        raise InputError(f"--payload: got {payload:g}, expected a finite number >= 0")
    if seconds is not None and not (0.0 < seconds < np.inf and goals != "grid"):
        raise InputError(f"--seconds: got {seconds:g} with --goals {goals}, expected > 0, and not a grid")
    if points < 1:
        raise InputError(f"--points: got {points}, expected at least 1")
    controller = _controller(policy)
    poses = read_goals(goals, controller.policy, points)
    if out.exists():
        raise InputError(f"--out: got {out}, which is there already, expected a new folder")
    driver = options.open(controller.policy.spec)
    first_frame(driver, f"--arm: {options.arm}")
    check_arm(driver, controller, f"--arm {options.arm}")

    out.mkdir(parents=True)
    payload_kg = None if payload is None else controller.policy.spec.mass.payload_kg + 1e-3 * payload
    if payload and hasattr(driver, "attach"):
        driver.attach(payload_kg)

    def save(log: Log) -> None:
        known_kg = None if payload_kg is None else np.full(len(log), payload_kg)
        save_log(out / "log.npz", replace(log, payload_kg=known_kg))

    if seconds is None:
        run = follow(driver, controller, poses, tell=tell, save=save)
    else:
        pace_s = seconds / max(len(poses) - 1, 1)
        run = trace(driver, controller, poses, pace_s, tell=tell, save=save)
    finish(driver)
    print_run(run, controller.policy)
    print_origin(controller.policy, options.arm)
    if run.arrivals:
        _report_accuracy(run, controller, poses, out, payload_kg)
    return run.status


def _report_accuracy(
    run: LoopRun, controller: Controller, poses: np.ndarray, out: Path, payload_kg: float | None
) -> None:
    """Write and print the figures of a run towards poses (p, 6) [mm, deg], and what makes its error."""
    accuracy = measure(run, controller, poses)
    ways = ways_of(run)
    numbers = figures(accuracy, run.counts(), controller.policy.reward.asked) | {
        "reached": sum(arrival.reached for arrival in run.arrivals),
        "seconds": float(run.log.time_s[-1]),
        **(along(ways, controller.dt_s) if ways else {}),
    }
    split = None if ways else budget(accuracy, controller.policy, payload_kg)
    if split is not None:
        numbers["budget"] = split.figures()
    if missing := write_accuracy(out, accuracy, numbers, ways):
        print(missing)
    elif split is not None:
        draw(split, out / "budget.png")
    print(f"figures: {out / 'accuracy.json'}")
    print_figures(numbers)
    if split is not None:
        print("\n".join(split.lines()))


def _record(
    options: Arms,
    out: Path,
    spec: cli.SpecFile = None,
    poses: int = 100,
    seed: int = 0,
) -> int:
    """Log an arm at random poses and between them, for calibration; the first ten poses grow from a tenth.

    It ends once more poses bring nothing, or with Ctrl-C: what was recorded is written.

    Args:
        out: log of every tick to write, npz or CSV; npz takes 0.25 MB a pose
        poses: number of random poses, at most
        seed: seed of the poses
    """
    if poses < 1:
        raise InputError(f"--poses: got {poses}, expected at least 1")
    twin = twin_spec(options.arm)
    arm_spec = ArmSpec.of(spec or twin)
    check_file("--out", out)

    driver = options.open(arm_spec)
    check_number(driver, arm_spec, f"--arm {options.arm}")
    low, high = arm_spec.chambers.pressure_min_kpa, arm_spec.chambers.pressure_max_kpa
    default = "" if spec or twin else ", by default; --spec names another arm"
    tell(f"arm: {arm_spec.name}, {arm_spec.n_chambers} chambers, {low:g} to {high:g} kPa{default}")
    tell(ACCURACY)
    if not hasattr(driver, "motion_capture"):
        tell("no motion capture: this log calibrates the springs alone; --capture adds it")

    targets_kpa = growing(random_pressures(arm_spec, poses, seed))
    result = record(driver, arm_spec, targets_kpa, tell, partial(save_log, out))
    finish(driver)
    if not len(result.log):
        print(f"no pose was logged: {result.ending.cause or 'none came to rest'}", file=sys.stderr)
        return result.ending.status or MISSED
    unseen = "; the arm has no motion capture, so tip and markers are missing" * (result.log.tip_m is None)
    if result.ending.status != cli.ERROR:
        print(f"log: {out}, {len(result.log)} rows, {result.n_poses} poses at rest{unseen}")
    for fault in wiring_faults(result.log, arm_spec):
        print(f"wiring: {fault}", file=sys.stderr)
    if result.n_unsettled:
        print(f"{result.n_unsettled} poses were not seen at rest in time")
    if result.ending.cause:
        print(f"ended early: {result.ending.cause}", file=sys.stderr)
    return result.ending.status


def finish(driver: Any) -> None:
    """End the motion capture that `--capture` began, and report its frames in a line."""
    if isinstance(driver, CapturedArm):
        tell(driver.finish())


def tell(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
