"""Command line: `python -m mjx_softarm.deploy {run,record}`.

Exit codes: 0 done, 2 it could not begin or its log not be written, 3 a fault ended the run or refused a
goal, 130 Ctrl-C. The log is written in every case but 2.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjx_softarm.deploy.arms import ArmError, open_arm
from mjx_softarm.deploy.faults import RESPONSE, Response
from mjx_softarm.deploy.loop import Controller, Phase
from mjx_softarm.deploy.record import record
from mjx_softarm.deploy.session import Run, follow
from mjx_softarm.logs.schema import write_log
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.policy.file import SealedFileError, load_policy
from mjx_softarm.spec import ArmSpec, SpecError

_ERROR, _FAULT, _INTERRUPTED = 2, 3, 130


class CommandError(Exception):
    """The command cannot be carried out; the message is all that its user needs."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    args = _parser().parse_args(argv)
    try:
        return args.run(args)
    except (CommandError, ArmError, SealedFileError, SpecError, OSError) as error:
        print(f"mjx_softarm.deploy {args.command}: error: {error}", file=sys.stderr)
        return _ERROR


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m mjx_softarm.deploy", description="A policy on an arm.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    arm_help = (
        "twin:SEED, a simulated arm; twin:SEED:pipe300, in a pipe; or package.module:Class, your driver"
    )

    run = commands.add_parser("run", help="bring the tip to goals")
    run.add_argument("policy", type=Path, metavar="ACTOR.npz", help="file of `python -m train export`")
    run.add_argument("--arm", required=True, help=arm_help)
    run.add_argument(
        "--goal",
        type=_goal,
        action="append",
        required=True,
        metavar="X,Y,Z,YAW,PITCH,ROLL",
        help="pose of the tip [mm, deg] in the base frame; again for a further one; where it begins "
        "with a minus, --goal=-10,...",
    )
    run.add_argument("--log", type=Path, metavar="CSV", help="write the run's log, CSV or npz")
    run.add_argument("--duration", type=_positive, metavar="S", help="end after so many seconds of the arm")
    run.set_defaults(run=_run)

    rec = commands.add_parser("record", help="log random poses for calibration")
    rec.add_argument("--arm", required=True, help=arm_help)
    rec.add_argument("--spec", type=Path, metavar="ARM.toml", help="the arm; default: the paper's arm")
    rec.add_argument("--out", type=Path, required=True, metavar="CSV", help="log to write, CSV or npz")
    rec.add_argument("--poses", type=_count, default=500, help="default: %(default)s")
    rec.add_argument("--seed", type=int, default=0, help="of the poses; default: %(default)s")
    rec.add_argument("--transients", action="store_true", help="log every tick, not the poses at rest alone")
    rec.set_defaults(run=_record)
    return parser


def _goal(text: str) -> np.ndarray:
    try:
        goal = np.array([float(value) for value in text.split(",")])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"got {text!r}: {error}") from error
    if goal.shape != (6,):
        raise argparse.ArgumentTypeError(f"got {len(goal)} numbers, expected x,y,z,yaw,pitch,roll")
    return goal


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"got {text}, expected a number > 0")
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"got {text}, expected at least 1")
    return value


def _run(args: argparse.Namespace) -> int:
    policy = load_policy(args.policy)
    _check_folder("--log", args.log)
    controller = Controller.of(policy)
    run = follow(
        open_arm(args.arm), controller, args.goal, args.duration, lambda text: print(text, flush=True)
    )
    if args.log:
        write_log(args.log, run.log)
        print(f"log: {args.log}, {len(run.log)} rows")
    _summary(run)
    if run.interrupted:
        return _INTERRUPTED
    stopped = any(RESPONSE[fault] is not Response.GO_ON for fault in run.counts())
    return _FAULT if stopped else 0


def _summary(run: Run) -> None:
    for fault, count in run.counts().items():
        print(f"fault: {fault.value}: {count} times, {RESPONSE[fault].value}")
    if len(run.latency_s):
        median, high = 1e3 * np.quantile(run.latency_s, (0.5, 0.999))
        n = len(run.latency_s)
        print(f"from readings to pressures: median {median:.2f} ms, 99.9 % {high:.2f} ms of {n} ticks")
    left = "vented" if run.phase is Phase.DONE else "left at the last pressures"
    print(f"{len(run.arrivals)} goals done; the arm is {left}")


def _record(args: argparse.Namespace) -> int:
    spec = ArmSpec.from_toml(args.spec) if args.spec else ArmSpec.default()
    _check_folder("--out", args.out)
    targets_kpa = random_pressures(spec, args.poses, args.seed)
    result = record(
        open_arm(args.arm), spec, targets_kpa, args.transients, lambda text: print(text, flush=True)
    )
    if not len(result.log):
        raise CommandError(f"no pose was logged: {result.problem or 'none came to rest'}")
    write_log(args.out, result.log)
    unseen = (
        ""
        if result.log.tip_m is not None
        else "; the arm has no motion capture, so tip and markers are missing"
    )
    print(f"log: {args.out}, {len(result.log)} rows, {result.n_poses} poses at rest{unseen}")
    if result.n_unsettled:
        print(f"{result.n_unsettled} poses did not come to rest in time")
    if result.problem:
        print(f"ended early: {result.problem}", file=sys.stderr)
        return _INTERRUPTED if result.problem == "interrupted" else _FAULT
    return 0


def _check_folder(option: str, path: Path | None) -> None:
    """A log that cannot be written is to be known before the arm moves."""
    if path is not None and not path.parent.is_dir():
        raise CommandError(f"{option}: {path.parent} is no folder")
    if path is not None and path.is_dir():
        raise CommandError(f"{option}: {path} is a folder, expected a file")


if __name__ == "__main__":
    sys.exit(main())
