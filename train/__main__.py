"""Command line: `python -m train reach | imitate | evaluate | export | sweep | demos`."""

from __future__ import annotations

import os

# XLA logs a page for every program that it takes from the cache.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from mjx_softarm._support import xla
from mjx_softarm._support.archive import SealedFileError
from mjx_softarm.deploy.arms import ArmError
from mjx_softarm.logs.checks import LogError
from mjx_softarm.sensing.s2r import S2R, S2R_FILE, load_s2r
from mjx_softarm.spec import ARM_FILE, ArmSpec, SpecError
from train.config import (
    IMITATION_PRESETS,
    IMITATION_PRESETS_HELP,
    PRESETS,
    ConfigError,
    override,
)
from train.demos.command import add_commands
from train.demos.demonstrations import from_log, read_demonstrations
from train.demos.expert import ExpertError
from train.epoch import devices
from train.options import add_arm, check_resume_alone
from train.runs.checkpoint import Run, RunError, sole_trainer
from train.runs.evaluate import N_ACTIONS
from train.sweep.command import add_sweep

if TYPE_CHECKING:
    from jax.sharding import Mesh

    from train.runs.task import Task


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    options = _parser().parse_args(arguments)
    console = Console()
    xla.enable_compilation_cache()
    try:
        return options.command(options, console)
    except (
        RunError,
        ConfigError,
        SpecError,
        SealedFileError,
        LogError,
        ArmError,
        ExpertError,
        OSError,
    ) as error:
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
    _add_run(reach, PRESETS, "quick", "runs/reach-PRESET-seedSEED")
    reach.set_defaults(command=_reach)
    imitate = commands.add_parser("imitate", help="train a policy that reaches positions as they were shown")
    imitate.add_argument(
        "file", type=Path, nargs="?", metavar="FILE", help="demonstrations as `demos record` writes them"
    )
    _add_run(imitate, IMITATION_PRESETS, "pipe", "runs/imitate-PRESET-seedSEED", IMITATION_PRESETS_HELP)
    imitate.add_argument(
        "--pipe",
        type=float,
        metavar="MM",
        help="diameter of the pipe that the body is to stay inside, as the evaluation counts; default: none",
    )
    imitate.add_argument("--agent", type=Path, metavar="RUN", help="begin with this run's actor and critics")
    imitate.add_argument(
        "--reward", type=Path, metavar="RUN", help="take the reward that this run learned, and leave it so"
    )
    imitate.set_defaults(command=_imitate)
    evaluate = commands.add_parser("evaluate", help="a run's newest policy, with figures and pictures")
    evaluate.add_argument("run", type=Path, help="folder of the run")
    evaluate.set_defaults(command=_evaluate)
    export = commands.add_parser("export", help="write policies, each as one npz file")
    export.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folder of a run")
    export.add_argument("--out", type=Path, help="default: RUN/policy.npz")
    export.set_defaults(command=_export)
    add_sweep(commands, _arm)
    add_commands(commands, _arm)
    return parser


def _add_run(
    parser: argparse.ArgumentParser, presets: Iterable[str], default: str, folder: str, more: str = ""
) -> None:
    """The options that all runs have."""
    parser.add_argument("--preset", choices=presets, help=f"{more}default: {default}")
    parser.add_argument("--seed", type=int, help="of networks, exploration, goals and batches; default: 0")
    add_arm(parser)
    parser.add_argument("--engine", choices=("chain", "mjx"), help="kinematics; default: chain")
    parser.add_argument("--mode", choices=("quasistatic", "dynamic"), help="default: quasistatic")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="any setting, e.g. tqc.gamma=0.95"
    )
    parser.add_argument("--out", type=Path, help=f"folder of the run; default: {folder}")
    parser.add_argument("--resume", type=Path, metavar="RUN", help="continue this run; its own settings hold")
    parser.add_argument("--devices", metavar="D", help=devices.HELP)


def _reach(options: argparse.Namespace, console: Console) -> int:
    from mjx_softarm.env import ReachEnv
    from train.runs.run import default_path
    from train.runs.task import task_of

    mesh = _mesh(options, console)
    if options.resume:
        return _resume(options, mesh, console)
    preset = options.preset or "quick"
    config = _config(PRESETS[preset], options)
    spec, s2r = _arm(options, console)
    console.print("drawing goals from the reachable workspace ...")
    task = task_of(config, ReachEnv(spec, config.env, s2r), mesh=mesh)
    path = options.out or default_path("reach", preset, config.seed)
    return _train(Run.create(path, config, spec, s2r), task, console)


def _imitate(options: argparse.Namespace, console: Console) -> int:
    from mjx_softarm.env import ReachEnv
    from train.runs.run import begin_with, default_path
    from train.runs.task import task_of

    mesh = _mesh(options, console)
    if options.resume:
        return _resume(options, mesh, console)
    if options.file is None:
        raise ConfigError("FILE: missing, expected the demonstrations, or --resume RUN")
    preset = options.preset or "pipe"
    assignments = [] if options.pipe is None else [f"env.pipe_diameter_mm={options.pipe}"]
    assignments += ["frozen=true"] if options.reward else []
    config = _config(IMITATION_PRESETS[preset], options, assignments)
    if config.frozen and not options.reward:
        raise ConfigError("frozen: got true, expected --reward RUN, the run whose learned reward it takes")
    if options.reward and not config.learned_weight:
        raise ConfigError(f"--reward {options.reward}: got learned_weight 0, expected more, for its reward")
    spec, s2r = _arm(options, console)
    log, _ = read_demonstrations(options.file, spec)
    donors = {name: path for name in ("agent", "reward") if (path := getattr(options, name))}
    task = task_of(config, ReachEnv(spec, config.env, s2r), from_log(log, spec), mesh)
    state = begin_with(task, config.seed, **{name: Run.open(path) for name, path in donors.items()})
    path = options.out or default_path("imitate", preset, config.seed)
    return _train(Run.create(path, config, spec, s2r, log, donors, state), task, console)


def _mesh(options: argparse.Namespace, console: Console) -> Mesh | None:
    """The devices to train on; of several processes, one speaks."""
    mesh = devices.mesh_of(options.devices)
    console.quiet = not devices.is_first_process()
    return mesh


def _resume(options: argparse.Namespace, mesh: Mesh | None, console: Console) -> int:
    from train.runs.run import task_of_run

    check_resume_alone(options, "run")
    run = Run.open(options.resume)
    return _train(run, task_of_run(run, mesh), console)


def _config(preset: Any, options: argparse.Namespace, assignments: Sequence[str] = ()) -> Any:
    """A preset with the settings of the command line."""
    shortcuts = {"seed": options.seed, "env.engine": options.engine, "env.mode": options.mode}
    given = [f"{name}={value}" for name, value in shortcuts.items() if value is not None]
    return override(preset, [*assignments, *given, *options.set])


def _train(run: Run, task: Task, console: Console) -> int:
    from train.runs.run import Interrupted, train

    console.print(f"run: {run.path}", highlight=False)
    try:
        with sole_trainer(run.path):
            summary = train(run, task, console)
    except Interrupted as stop:
        console.print(str(stop), highlight=False)
        return 130
    _show(run, task, summary, console)
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


def _evaluate(options: argparse.Namespace, console: Console) -> int:
    from train.runs.run import finish, restore_policy

    run = Run.open(options.run)
    task, policy = restore_policy(run)
    _show(run, task, finish(run, task, policy), console)
    return 0


def _export(options: argparse.Namespace, console: Console) -> int:
    from train.runs.export import export_run

    if options.out and len(options.runs) > 1:
        raise ConfigError(f"--out {options.out}: got {len(options.runs)} runs, expected one with it")
    for path in options.runs:
        console.print(f"policy: {export_run(Run.open(path), options.out)}", highlight=False)
    return 0


def _show(run: Run, task: Task, summary: Any, console: Console) -> None:
    table = Table(title=f"{task.title}, {N_ACTIONS} actions each", title_justify="left")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in summary.rows():
        table.add_row(name, value)
    console.print(table)
    for name in task.picture_names:
        console.print(f"picture: {run.path / name}", highlight=False, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
