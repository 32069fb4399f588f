"""Command line: `python -m train reach | evaluate | export | demos`."""

from __future__ import annotations

import os

# XLA logs a page for every program that it takes from the cache.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import argparse
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from mjx_softarm.archive import SealedFileError
from mjx_softarm.checks import LogError
from mjx_softarm.deploy.arms import ArmError
from mjx_softarm.s2r import S2R, S2R_FILE, load_s2r
from mjx_softarm.spec import ARM_FILE, ArmSpec, SpecError
from train.checkpoint import Run, RunError
from train.config import PRESETS, ConfigError, override
from train.demos import add_commands
from train.evaluate import N_ACTIONS, N_GOALS, Summary
from train.expert import ExpertError

PICTURES = ("learning_curve.png", "circle.png", "workspace_error.png")


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    options = _parser().parse_args(arguments)
    console = Console()
    try:
        return options.command(options, console)
    except (RunError, ConfigError, SpecError, SealedFileError, LogError, ArmError, ExpertError) as error:
        Console(stderr=True).print(f"error: {error}", markup=False, highlight=False, soft_wrap=True)
        return 2
    except KeyboardInterrupt:
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m train", description="Train, evaluate and export policies."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    reach = commands.add_parser("reach", help="train a policy that reaches poses of the workspace")
    reach.add_argument("--preset", choices=PRESETS, help="default: quick")
    reach.add_argument("--seed", type=int, help="of networks, exploration, goals and batches; default: 0")
    reach.add_argument("--spec", type=Path, help="TOML file of the arm; default: the paper's arm")
    reach.add_argument(
        "--calibration", type=Path, metavar="DIR", help="folder that `python -m calib run` made, for --spec"
    )
    reach.add_argument("--engine", choices=("chain", "mjx"), help="kinematics; default: chain")
    reach.add_argument("--mode", choices=("quasistatic", "dynamic"), help="default: quasistatic")
    reach.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="any setting, e.g. tqc.gamma=0.95"
    )
    reach.add_argument("--out", type=Path, help="folder of the run; default: runs/reach-PRESET-seedSEED")
    reach.add_argument("--resume", type=Path, metavar="RUN", help="continue this run; its own settings hold")
    reach.set_defaults(command=_reach)
    evaluate = commands.add_parser("evaluate", help="held-out goals and the circle, with pictures")
    evaluate.add_argument("run", type=Path, help="folder of the run")
    evaluate.set_defaults(command=_evaluate)
    export = commands.add_parser("export", help="write the policy as one npz file")
    export.add_argument("run", type=Path, help="folder of the run")
    export.add_argument("--out", type=Path, help="default: RUN/policy.npz")
    export.set_defaults(command=_export)
    add_commands(commands, _arm)
    return parser


def _reach(options: argparse.Namespace, console: Console) -> int:
    from mjx_softarm import xla
    from mjx_softarm.env import ReachEnv
    from train.run import Interrupted, default_path, train

    xla.enable_compilation_cache()
    if options.resume:
        if _given(options):
            raise ConfigError(f"--resume goes alone: the run's own settings hold, got {_given(options)} too")
        run = Run.open(options.resume)
        env = ReachEnv(run.spec, run.config.env, run.s2r)
    else:
        preset = options.preset or "quick"
        shortcuts = {"seed": options.seed, "env.engine": options.engine, "env.mode": options.mode}
        assignments = [f"{name}={value}" for name, value in shortcuts.items() if value is not None]
        config = override(PRESETS[preset], [*assignments, *options.set])
        spec, s2r = _arm(options, console)
        path = options.out or default_path("reach", preset, config.seed)
        console.print("drawing goals from the reachable workspace ...")
        env = ReachEnv(spec, config.env, s2r)
        run = Run.create(path, config, spec, s2r)
    console.print(f"run: {run.path}", highlight=False)
    try:
        summary = train(run, env, console)
    except Interrupted as stop:
        console.print(str(stop), highlight=False)
        return 130
    _show(run, summary, console)
    return 0


def _arm(options: argparse.Namespace, console: Console) -> tuple[ArmSpec, S2R | None]:
    """The arm to train for: calibrated, specified or the paper's."""
    if options.calibration is None:
        return ArmSpec.from_toml(options.spec) if options.spec else ArmSpec.default(), None
    if options.spec:
        raise ConfigError(f"--spec {options.spec}: got --calibration {options.calibration} too, expected one")
    spec, file = ArmSpec.from_toml(options.calibration / ARM_FILE), options.calibration / S2R_FILE
    if file.exists():
        return spec, load_s2r(file, spec.n_chambers)
    console.print(f"no {file}: training on simulated poses", highlight=False, soft_wrap=True)
    return spec, None


def _given(options: argparse.Namespace) -> str:
    """The options of a new run that the command line has."""
    given = {
        f"--{name}": getattr(options, name)
        for name in ("preset", "seed", "spec", "calibration", "engine", "mode", "set", "out")
    }
    return ", ".join(name for name, value in given.items() if value not in (None, []))


def _evaluate(options: argparse.Namespace, console: Console) -> int:
    from train.evaluate import Evaluator
    from train.run import finish, restore_actor

    run = Run.open(options.run)
    job, actor_params = restore_actor(run)
    _show(run, finish(run, Evaluator(job.env, job.agent), actor_params), console)
    return 0


def _export(options: argparse.Namespace, console: Console) -> int:
    from train.export import export_run

    path = export_run(Run.open(options.run), options.out)
    console.print(f"policy: {path}", highlight=False)
    return 0


def _show(run: Run, summary: Summary, console: Console) -> None:
    table = Table(title=f"{N_GOALS} held-out goals, {N_ACTIONS} actions each", title_justify="left")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in (
        ("tip error, median", f"{summary.median_mm:.2f} mm"),
        ("tip error, 95 %", f"{summary.p95_mm:.2f} mm"),
        ("goals reached", f"{100 * summary.reached_share:.1f} %"),
        ("goals with a saturated chamber", f"{100 * summary.saturated_share:.1f} %"),
        ("arms that did not settle", f"{summary.unsettled}"),
        ("circle, mean tip error", f"{summary.circle_mean_mm:.2f} mm"),
        ("circle, largest tip error", f"{summary.circle_max_mm:.2f} mm"),
        ("circle, saturated chambers", f"{summary.circle_saturated_chambers}"),
    ):
        table.add_row(name, value)
    console.print(table)
    for name in PICTURES:
        console.print(f"picture: {run.path / name}", highlight=False, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
