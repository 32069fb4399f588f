"""Command `python -m train sweep`: seeds and settings of reaching, all trained as one job."""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from mjx_softarm.sensing.s2r import S2R
from mjx_softarm.spec import ArmSpec
from train.config import PRESETS, ConfigError, TrainConfig, override
from train.options import add_arm, check_resume_alone
from train.runs.checkpoint import sole_trainer
from train.sweep.job import VARIABLE, setting

_WIDTH = 160  # of the table where it is printed elsewhere than to a terminal

ArmOf = Callable[[argparse.Namespace, Console], tuple[ArmSpec, S2R | None]]


def add_sweep(commands: argparse._SubParsersAction, arm_of: ArmOf) -> None:
    """Add `sweep` to a parser; `arm_of` gives the arm of options `spec` and `calibration`."""
    sweep = commands.add_parser("sweep", help="train `reach` with several seeds and settings, all at once")
    sweep.add_argument("--preset", choices=PRESETS, help="default: quick")
    sweep.add_argument("--seeds", metavar="SEED,SEED,...", help="of each setting; default: 0")
    sweep.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="NAME=VALUE,VALUE,...",
        help="train with each of these values, e.g. tqc.gamma=0.5,0.9; with several, with each combination",
    )
    add_arm(sweep)
    sweep.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="any setting of all members, e.g. total_env_steps=10000",
    )
    sweep.add_argument("--out", type=Path, help="folder of the sweep; default: runs/sweep-PRESET")
    sweep.add_argument(
        "--resume", type=Path, metavar="SWEEP", help="continue this one; its own settings hold"
    )
    sweep.set_defaults(command=lambda options, console: _sweep(options, console, arm_of))


def _sweep(options: argparse.Namespace, console: Console, arm_of: ArmOf) -> int:
    from train.runs.run import Interrupted, free_path
    from train.sweep.report import CURVES_FILE, RESULTS_FILE, report
    from train.sweep.run import create, open_sweep, train

    if options.resume:
        check_resume_alone(options, "sweep")
        sweep = open_sweep(options.resume)
    else:
        preset = options.preset or "quick"
        members, varied = members_of(PRESETS[preset], options.set, options.seeds or "0", options.vary)
        spec, s2r = arm_of(options, console)
        path = options.out or free_path(Path("runs") / f"sweep-{preset}")
        sweep = create(path, members, varied, spec, s2r)
    console.print(f"sweep: {sweep.path}, {len(sweep.runs)} members", highlight=False)
    try:
        with sole_trainer(sweep.path):
            train(sweep, console)
    except Interrupted as stop:
        console.print(str(stop), highlight=False)
        return 130
    wide = console if console.is_terminal else Console(file=console.file, width=_WIDTH)
    wide.print(report(sweep))
    for what, name in (("results", RESULTS_FILE), ("picture", CURVES_FILE)):
        console.print(f"{what}: {sweep.path / name}", highlight=False, soft_wrap=True)
    return 0


def members_of(
    preset: TrainConfig, assignments: Sequence[str], seeds: str, vary: Sequence[str]
) -> tuple[dict[str, TrainConfig], tuple[str, ...]]:
    """The members of a sweep: each seed with each combination of the varied settings.

    Args:
        preset: what they have in common,
        assignments: but for these settings, NAME=VALUE.
        seeds: N,N,...
        vary: NAME=VALUE,VALUE,... for each setting that is varied.

    Returns:
        Configs by names such as `seed0-tqc.gamma=0.5`, and the names of the varied settings.

    Raises:
        ConfigError: a setting is unknown or cannot be varied, a value cannot be used or comes twice.
    """
    texts = {"seed": _values("--seeds", seeds)}
    for assignment in vary:
        path, equals, values = assignment.partition("=")
        if not equals:
            raise ConfigError(f"--vary {assignment}: expected NAME=VALUE,VALUE,...")
        if path in texts:
            raise ConfigError(
                f"--vary {assignment}: {path} stands there already; expected all its values in one"
            )
        texts[path] = _values(f"--vary {assignment}", values)
    for assignment in assignments:
        if assignment.partition("=")[0] in texts:
            raise ConfigError(f"--set {assignment}: a value for all, but --seeds or --vary has one for each")
    varied = tuple(texts)[1:]
    members = {}
    for combination in itertools.product(*texts.values()):
        own = [f"{path}={text}" for path, text in zip(texts, combination, strict=True)]
        config = override(preset, [*assignments, *own])
        for path in varied:
            _check_variable(path, setting(config, path))
        members["-".join([f"seed{combination[0]}", *own[1:]])] = config
    if len(set(members.values())) < math.prod(map(len, texts.values())):
        raise ConfigError("--seeds, --vary: a value comes twice; expected different ones")
    return members, varied


def _values(option: str, text: str) -> list[str]:
    values = [value.strip() for value in text.split(",")]
    if "" in values:
        raise ConfigError(f"{option}: got an empty value, expected values with commas between them")
    return values


def _check_variable(path: str, value: object) -> None:
    if path not in VARIABLE:
        raise ConfigError(
            f"--vary {path}: decides what is computed or on what shapes, so it is the same for all members, "
            f"set by --set; expected one of {', '.join(VARIABLE)}"
        )
    if not isinstance(value, float):
        raise ConfigError(f"--vary {path}: got {value}, expected numbers")
